"""The benchmark of labelling, on few voxels: the labels and logits of the sparse evaluation are those of cubes."""

import numpy as np

from benchmarks import bench_labelling


def test_the_city_s_grid_is_compared_with_cubes(monkeypatch):
    monkeypatch.setattr(bench_labelling, "N_CUBES", 16)
    grid = bench_labelling._street_grid(500_000)
    small = grid.select(np.abs(grid.keys[:, 0] - np.median(grid.keys[:, 0])) < 5)
    rows = {(r["benchmark"], r["metric"], r["peer"]): r["value"] for r in bench_labelling._bench_grid("city", small, 40)}
    assert rows["label_city", "equal_labels", "cube by cube"] == 1
    assert rows["label_city", "largest_difference", "cube by cube"] < 1e-4
    assert rows["label_city", "ratio", "cube by cube"] > 0
