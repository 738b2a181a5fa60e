"""Pictures of cameras in a panel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt


def show_pictures(gui: Any, folder: Any, shown: dict[str, Any], images: Mapping[str, npt.NDArray[np.uint8]]) -> None:
    """Show pictures in place of those before.

    Args:
        gui: The page's panels.
        folder: Where pictures of further cameras are added.
        shown: Camera to its picture in the panel; further ones are added.
        images: Camera to its picture.
    """
    for name, image in images.items():
        if name in shown:
            shown[name].image = image
        else:
            with folder:
                shown[name] = gui.add_image(image, label=name, jpeg_quality=85)
