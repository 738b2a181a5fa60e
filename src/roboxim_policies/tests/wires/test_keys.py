"""Keys of a convention and of a server: no picture takes the place of another one."""

from __future__ import annotations

import numpy as np
import pytest

from roboxim_core.conventions import ActionOutput, Chunking, Convention, ImageInput, observe
from roboxim_core.errors import InvalidRequestError
from roboxim_core.policies import Observation
from roboxim_core.proprioception import Proprioception
from roboxim_policies.wires.parts import named
from roboxim_policies.wires.vla_eval import observation


@pytest.mark.parametrize(
    ("key", "sent", "found"),
    [
        ("front.rgb", ["observation/front/rgb", "observation/wrist/rgb"], ["observation/front/rgb"]),
        ("front", ["video.front", "video.wrist"], ["video.front"]),
        ("video.front", ["front", "wrist"], ["front"]),
        ("rgb", ["observation/front/rgb", "observation/wrist/rgb"], ["observation/front/rgb", "observation/wrist/rgb"]),
        ("top", ["front"], []),
    ],
)
def test_a_server_s_key_names_one_entry_or_is_ambiguous(key, sent, found):
    assert named(key, sent) == found


def test_pictures_whose_keys_end_alike_are_refused_where_only_the_end_is_sent():
    images = tuple(
        ImageInput(camera=camera, key=f"observation/{camera}/rgb", width=8, height=8)
        for camera in ("workspace", "wrist")
    )
    convention = Convention(
        name="mine", description="x", rate_hz=20, images=images, action=ActionOutput(), chunking=Chunking()
    )
    pictures = {"workspace": np.full((8, 8, 3), 10, np.uint8), "wrist": np.full((8, 8, 3), 20, np.uint8)}
    request = observe(convention, [Observation(seq=0, stamp_ns=0, images=pictures, proprio=Proprioception())], "pick")
    with pytest.raises(InvalidRequestError, match="images have equal ones: .*workspace/rgb, .*wrist/rgb; rename them"):
        observation(request, convention.prompt.key)
