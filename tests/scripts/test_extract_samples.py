import numpy as np
import pytest

from scripts.extract_samples import main
from streetscan.errors import BadInput
from streetscan.segmentation.samples import vote_labels
from streetscan.voxels import voxelize


@pytest.fixture
def labelled(tiny_world, tmp_path):
    grid = voxelize([tiny_world.cloud.points], 0.1)
    labels = vote_labels(grid, [(tiny_world.cloud.points, tiny_world.labels)])
    grid.save(tmp_path / "voxels.npz")
    np.save(tmp_path / "labels.npy", labels)
    return grid, labels, tmp_path


def test_samples_point_to_voxels_of_their_class(labelled):
    grid, labels, folder = labelled
    main(folder / "voxels.npz", folder / "labels.npy", folder / "samples.npz", n_per_class=50, seed=1, expected=["phantom", "car"])
    samples = np.load(folder / "samples.npz")
    assert samples["keys"].dtype == np.int32
    np.testing.assert_array_equal(np.bincount(samples["labels"]), np.full(9, 50))
    np.testing.assert_array_equal(labels[grid.find(samples["keys"])], samples["labels"])


def test_the_same_seed_writes_the_same_file(labelled):
    *_, folder = labelled
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        main(folder / "voxels.npz", folder / "labels.npy", folder / name, n_per_class=50, seed=seed)
    a, b, c = ((folder / name).read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_a_promised_class_that_is_missing_is_named(labelled):
    _, labels, folder = labelled
    np.save(folder / "labels.npy", np.where(labels == 4, 255, labels))
    with pytest.raises(BadInput, match="class pedestrian"):
        main(folder / "voxels.npz", folder / "labels.npy", folder / "s.npz", n_per_class=5, seed=1, expected=["car", "pedestrian"])
    assert not (folder / "s.npz").exists()


def test_labels_of_other_voxels_are_refused(labelled):
    _, labels, folder = labelled
    np.save(folder / "labels.npy", labels[:-1])
    with pytest.raises(BadInput, match=r"labels\.npy"):
        main(folder / "voxels.npz", folder / "labels.npy", folder / "samples.npz", n_per_class=5, seed=1)
