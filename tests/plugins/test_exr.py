"""OpenEXR files: what is written is what is read, and a failure leaves nothing behind."""

from __future__ import annotations

import numpy as np
import OpenEXR
import pytest

from rimlight.exr import read_exr, replacing, write_exr


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)


def test_layers_and_metadata_return(tmp_path, image):
    layers = {"": image, "standard_error": np.abs(image), "albedo.noisy": image[:, :, :1], "target": np.ones((5, 7, 4))}
    write_exr(tmp_path / "a.exr", layers, {"motion": "θ along x", "spp": 16, "step": 0.25})
    read, metadata = read_exr(tmp_path / "a.exr")
    assert read.keys() == layers.keys()
    for name, layer in layers.items():
        assert read[name].dtype == np.float32
        np.testing.assert_array_equal(read[name], layer.astype(np.float32))
    assert metadata == {"motion": "θ along x", "spp": "16", "step": "0.25"}


def test_channel_names(tmp_path, image):
    write_exr(tmp_path / "a.exr", {"": image, "x": image[:, :, :1]})
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert set(file.channels()) == {"R", "G", "B", "x.Y"}
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION


def test_values_that_are_not_finite_return(tmp_path):
    image = np.array([[[np.nan], [np.inf], [-0.0]]], np.float32)
    write_exr(tmp_path / "a.exr", {"": image})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0][""], image)


@pytest.mark.parametrize(
    ("layers", "metadata", "message"),
    [
        ({"": np.zeros((4, 4))}, {}, r'layer "" must be of shape'),
        ({"a": np.zeros((4, 4, 2))}, {}, r'layer "a" must be of shape'),
        ({"": np.zeros((0, 4, 3))}, {}, r"must be of shape"),
        ({"": np.zeros((4, 4, 3)), "b": np.zeros((4, 5, 3))}, {}, r"differ in size.*'b': \(4, 5\)"),
        ({}, {}, r"no layer"),
        ({"": np.zeros((4, 4, 3))}, {"channels": "x"}, r'"channels" cannot'),
    ],
)
def test_bad_input_is_refused(tmp_path, layers, metadata, message):
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "a.exr", layers, metadata)
    assert list(tmp_path.iterdir()) == []


def test_errors_name_the_file(tmp_path, image):
    with pytest.raises(OSError, match=r"missing.a\.exr"):
        write_exr(tmp_path / "missing" / "a.exr", {"": image})
    with pytest.raises(OSError, match=r"a folder"):
        write_exr(tmp_path, {"": image})
    with pytest.raises(FileNotFoundError, match=r"a\.exr"):
        read_exr(tmp_path / "a.exr")
    (tmp_path / "b.exr").write_text("no image")
    with pytest.raises(OSError, match=r"b\.exr: no OpenEXR file"):
        read_exr(tmp_path / "b.exr")
    write_exr(tmp_path / "c.exr", {"": image})
    data = (tmp_path / "c.exr").read_bytes()
    (tmp_path / "c.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(OSError, match=r"c\.exr"):
        read_exr(tmp_path / "c.exr")


def test_failure_keeps_the_old_file(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("old")

    def write_half() -> None:
        with replacing(file) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]
