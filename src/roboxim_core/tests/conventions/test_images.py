"""Pictures are turned, cropped, resized and laid out as a convention says."""

import numpy as np
import pytest

from roboxim_core.conventions import ImageInput
from roboxim_core.errors import InvalidRequestError


def image(**options):
    return ImageInput(camera="workspace", key="image", **options)


def quarters(height=100, width=100):
    """Return a picture whose quarters are red, green (right), blue (below) and white."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2, : width // 2, 0] = 255
    picture[: height // 2, width // 2 :, 1] = 255
    picture[height // 2 :, : width // 2, 2] = 255
    picture[height // 2 :, width // 2 :] = 255
    return picture


def test_a_picture_of_the_right_size_is_not_touched():
    picture = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    for resize in ("pad", "crop", "lanczos3", "bilinear", "none"):
        np.testing.assert_array_equal(image(resize=resize).prepare(picture), picture)


def test_a_mirrored_picture_has_left_and_right_exchanged_and_stays_upright():
    mirrored = image(width=100, height=100, mirror=True).prepare(quarters())
    assert mirrored[0, -1].tolist() == [255, 0, 0]
    assert mirrored[0, 0].tolist() == [0, 255, 0]
    assert mirrored[-1, -1].tolist() == [0, 0, 255]
    assert mirrored.flags.c_contiguous


def test_padding_keeps_the_shape_and_adds_black_bars():
    wide = image(width=100, height=100, resize="pad").prepare(np.full((50, 200, 3), 200, np.uint8))
    assert (wide[:37] == 0).all()  # 25 rows in the middle of 100, rounded as openpi-client does
    assert (wide[37:62] == 200).all()
    assert (wide[62:] == 0).all()
    tall = image(width=100, height=100, resize="pad").prepare(np.full((200, 50, 3), 200, np.uint8))
    assert (tall[:, :37] == 0).all()
    assert (tall[:, 37:62] == 200).all()


def test_cropping_to_the_shape_keeps_the_middle():
    picture = np.zeros((100, 200, 3), np.uint8)
    picture[:, 50:150] = 90
    np.testing.assert_array_equal(image(width=50, height=50, resize="crop").prepare(picture)[:, 3:-3], 90)
    stretched = image(width=50, height=50, resize="lanczos3").prepare(picture)
    assert not stretched[:, 5].any()


def test_a_crop_by_area_keeps_its_share_of_the_middle():
    """Test that a quarter of the area is the middle half of each side."""
    picture = np.zeros((100, 100, 3), np.uint8)
    picture[25:75, 25:75] = 120
    np.testing.assert_array_equal(image(width=100, height=100, crop_area=0.25).prepare(picture)[2:-2, 2:-2], 120)
    kept = image(width=100, height=100, crop_area=0.9).prepare(picture)
    assert kept.shape == (100, 100, 3)
    assert (kept.any(axis=2).sum(axis=0) > 0).sum() in range(52, 56)  # 50 / sqrt(0.9) = 52.7, and half pixels


def test_shrinking_does_not_alias():
    """Test that stripes narrower than a pixel of the result become their mean."""
    stripes = np.zeros((256, 256, 3), np.uint8)
    stripes[:, ::2] = 255
    for resize in ("lanczos3", "bilinear", "pad"):
        small = image(width=32, height=32, resize=resize).prepare(stripes)[4:-4, 4:-4].astype(int)
        assert abs(small - 127).max() <= 12, resize


def test_channels_come_first_on_request():
    prepared = image(width=100, height=100, layout="chw").prepare(quarters())
    assert prepared.shape == (3, 100, 100)
    assert prepared[:, 0, 0].tolist() == [255, 0, 0]
    assert prepared.flags.c_contiguous


def test_a_jpeg_round_trip_loses_colour_detail_before_resizing():
    noisy = np.random.default_rng(1).integers(0, 256, (100, 100, 3), dtype=np.uint8)
    prepared = image(width=100, height=100, jpeg_quality=95).prepare(noisy)
    assert prepared.shape == noisy.shape
    assert 5 < np.abs(prepared.astype(int) - noisy).mean() < 60
    smooth = np.full((100, 100, 3), 77, np.uint8)
    np.testing.assert_array_equal(image(width=100, height=100, jpeg_quality=95).prepare(smooth), smooth)


@pytest.mark.parametrize(
    "picture", [np.zeros((10, 10, 4), np.uint8), np.zeros((10, 10, 3), np.float32), np.zeros((10, 10), np.uint8)]
)
def test_what_is_no_picture_is_refused(picture):
    with pytest.raises(InvalidRequestError, match="must be uint8 of shape"):
        image().prepare(picture)


def test_another_size_is_refused_if_nothing_may_be_resized():
    with pytest.raises(InvalidRequestError, match="224 x 224 px, camera 'workspace' delivers 100 x 100"):
        image(resize="none").prepare(quarters())
