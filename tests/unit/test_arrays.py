import numpy as np
import pytest

from streetscan.errors import BadInput
from streetscan.io.arrays import load_npy, load_npz, save_npy, save_npz


def test_arrays_come_back(tmp_path):
    save_npy(tmp_path / "deep" / "a.npy", np.arange(5, dtype=np.uint8))
    np.testing.assert_array_equal(load_npy(tmp_path / "deep" / "a.npy", "step", 5), np.arange(5))
    save_npz(tmp_path / "a.npz", x=np.arange(3), y=np.float64(0.5))
    x, y = load_npz(tmp_path / "a.npz", ("x", "y"), "step")
    np.testing.assert_array_equal(x, np.arange(3))
    assert y == 0.5


def test_packed_arrays_come_back_from_less(tmp_path):
    mask = np.zeros((300, 400), np.uint8)
    mask[100:200, 50:90] = 5
    save_npz(tmp_path / "a.npz", is_packed=True, mask=mask)
    np.testing.assert_array_equal(load_npz(tmp_path / "a.npz", ("mask",), "step")[0], mask)
    assert (tmp_path / "a.npz").stat().st_size < mask.size / 50


def test_an_array_of_another_length_is_refused(tmp_path):
    save_npy(tmp_path / "a.npy", np.zeros((2, 3)))
    with pytest.raises(BadInput, match=r"\(2, 3\) instead of 3"):
        load_npy(tmp_path / "a.npy", "step", 3)


def test_other_files_are_refused(tmp_path):
    save_npz(tmp_path / "good.npz", x=np.arange(100))
    save_npy(tmp_path / "good.npy", np.arange(100))
    np.save(tmp_path / "pickle.npy", np.array([{}], object), allow_pickle=True)
    npz, npy = (tmp_path / "good.npz").read_bytes(), (tmp_path / "good.npy").read_bytes()
    for content in (b"", b"text", npz, npz[:60], npy[:60], npy[:200], (tmp_path / "pickle.npy").read_bytes()):
        (tmp_path / "a.npy").write_bytes(content)
        with pytest.raises(BadInput, match="run step again"):
            load_npy(tmp_path / "a.npy", "step")
    for content in (b"", b"text", npz[:60], npz[:-20], npy):
        (tmp_path / "a.npz").write_bytes(content)
        with pytest.raises(BadInput, match="run step again"):
            load_npz(tmp_path / "a.npz", ("x",), "step")
    with pytest.raises(BadInput, match="run step again"):
        load_npz(tmp_path / "good.npz", ("x", "y"), "step")
    with pytest.raises(BadInput, match="run step again"):
        load_npy(tmp_path / "missing.npy", "step")
