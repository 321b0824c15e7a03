"""Training: batches hold what the samples say, learning happens, an interrupted run ends like an uninterrupted one."""

import dataclasses

import numpy as np
import pytest
import torch
from toy_parts import PATCH_VOXELS, SETTINGS, make_part

from streetscan.errors import BadInput
from streetscan.segmentation import training
from streetscan.segmentation.c2cnn import C2CNN, Settings, extract_cubes
from streetscan.segmentation.sparse import open_workers, sparse_logits
from streetscan.segmentation.training import Part, Samples, Schedule, class_weights, score, train

SCHEDULE = Schedule(n_epochs=3, samples_per_epoch=600, patch_voxels=PATCH_VOXELS, samples_per_patch=8, samples_per_batch=64)


@pytest.fixture(scope="module")
def part():
    return make_part(1)


@pytest.fixture(scope="module")
def other_part():
    return make_part(2)


def test_runs_share_a_patch_and_cover_every_sample_once(part):
    runs = part.runs(8, 10_000, np.random.default_rng(0))
    assert sorted(np.concatenate(runs)) == list(range(len(part.samples)))
    for run in runs:
        assert 1 <= len(run) <= 8
        assert len(np.unique(part.samples.keys[run] // 15, axis=0)) == 1


def test_an_epoch_takes_as_many_samples_as_asked(part):
    n = sum(len(run) for run in part.runs(8, 100, np.random.default_rng(0)))
    assert 100 <= n < 108


@pytest.mark.parametrize("k", [9, 23])
def test_a_batch_gives_each_sample_the_logits_of_its_cube(k):
    settings = Settings(k=k, n_hidden=16)
    part = make_part(3, settings)
    runs = part.runs(5, 60, np.random.default_rng(0))
    turns = np.random.default_rng(0).integers(4, size=len(runs))
    channels, coords, wanted, labels = part.batch(runs, turns)
    picked, cube_turns = np.concatenate(runs), np.repeat(turns, [len(run) for run in runs])
    np.testing.assert_array_equal(labels, part.samples.labels[picked])
    network = C2CNN(settings, 1)
    cubes = extract_cubes(part.grid, part.channels, part.samples.keys[picked], cube_turns, k)
    with torch.no_grad():
        expected = network(torch.from_numpy(cubes)).numpy()
        ours = sparse_logits(network, channels, coords, wanted).numpy()
    np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_thinning_keeps_the_samples_own_voxels_and_lowers_counts():
    part = make_part(1)
    part.thin(0.1)
    runs = part.runs(8, 200, np.random.default_rng(0))
    turns = np.zeros(len(runs), np.int64)
    full, full_coords, wanted, _ = part.batch(runs, turns)
    thin, coords, _, _ = part.batch(runs, turns, np.random.default_rng(1))
    assert set(map(tuple, wanted)) <= set(map(tuple, coords)) < set(map(tuple, full_coords))
    assert np.expm1(thin[:, 0]).sum() < np.expm1(full[:, 0]).sum()


def test_what_fills_a_pillar_stays_where_thinning_takes_points():
    part = make_part(1, dataclasses.replace(SETTINGS, channels=("count", "pillar")))
    part.thin(0.1)
    runs = part.runs(8, 200, np.random.default_rng(0))
    turns = np.zeros(len(runs), np.int64)
    full, full_coords, _, _ = part.batch(runs, turns)
    thin, coords, _, _ = part.batch(runs, turns, np.random.default_rng(1))
    at = {tuple(c): value for c, value in zip(full_coords.tolist(), full[:, 1], strict=True)}
    assert len(thin) < len(full)
    assert len(set(full[:, 1].tolist())) > 1
    np.testing.assert_array_equal(thin[:, 1], [at[tuple(c)] for c in coords.tolist()])


def test_local_counts_stay_where_thinning_lowers_them():
    """The mean of the relative counts hardly moves; that of the counts falls."""
    means = {}
    for scale in ("log", "local"):
        part = make_part(1, dataclasses.replace(SETTINGS, count_scale=scale))
        part.thin(0.25)
        runs = part.runs(8, 450, np.random.default_rng(0))
        turns = np.zeros(len(runs), np.int64)
        drawn = [np.concatenate([part.batch(runs, turns, np.random.default_rng(i))[0][:, 0] for i in range(5)])]
        means[scale] = np.expm1(part.batch(runs, turns)[0][:, 0]).mean(), np.expm1(drawn[0]).mean()
    assert means["log"][1] < 0.8 * means["log"][0]
    assert means["local"][1] == pytest.approx(means["local"][0], rel=0.05)


def test_class_weights_by_hand():
    voxels = np.repeat(np.array([0, 1, 255], np.uint8), [900, 100, 50])
    samples = np.repeat(np.array([0, 1], np.uint8), [10, 10])
    np.testing.assert_allclose(class_weights(samples, voxels, 0.0)[:2], [1, 1])
    np.testing.assert_allclose(class_weights(samples, voxels, 1.0)[:2], [1.8, 0.2], rtol=1e-6)
    uneven = np.repeat(np.array([0, 1], np.uint8), [30, 10])
    even = class_weights(uneven, voxels, 0.0)
    np.testing.assert_allclose(even[:2] * [30, 10], [20, 20], rtol=1e-6)
    assert (even[2:] == 0).all()


def test_training_learns_and_its_history_says_so(part, other_part):
    network, history = train(SETTINGS, dataclasses.replace(SCHEDULE, n_epochs=6), part, other_part)
    assert [row["epoch"] for row in history] == list(range(1, 7))
    assert history[-1]["train_loss"] < history[0]["train_loss"]
    assert max(row["validation_accuracy"] for row in history) > 0.9
    best = max(row["validation_accuracy"] for row in history)
    with open_workers(1) as workers:
        assert score(network, other_part, torch.ones(9), workers)[1] == pytest.approx(best)


def test_the_learning_rate_falls_when_the_validation_accuracy_stops_rising(part, other_part, monkeypatch):
    monkeypatch.setattr(training, "score", lambda *_: (1.0, 0.5))
    _, history = train(SETTINGS, dataclasses.replace(SCHEDULE, n_epochs=4, samples_per_epoch=50, lr_patience=0), part, other_part)
    assert [row["learning_rate"] for row in history] == pytest.approx([0.05, 0.05, 0.015, 0.0045])


def test_equal_seeds_give_equal_networks(part, other_part):
    states = [train(SETTINGS, dataclasses.replace(SCHEDULE, n_epochs=1, seed=s), part, other_part)[0].state_dict() for s in (1, 1, 2)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not torch.equal(states[0]["output.weight"], states[2]["output.weight"])


def test_the_number_of_threads_changes_nothing(part, other_part):
    schedule = dataclasses.replace(SCHEDULE, n_epochs=1)
    a, b = (train(SETTINGS, schedule, part, other_part, n_threads=n)[0].state_dict() for n in (1, 3))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_resumed_equals_uninterrupted(part, other_part, tmp_path, monkeypatch):
    schedule = dataclasses.replace(SCHEDULE, thinning=0.5)
    whole, history = train(SETTINGS, schedule, part, other_part)
    run_epoch = training._run_epoch

    def die_in_epoch_3(*args):
        if args[-1] == 3:
            raise KeyboardInterrupt
        return run_epoch(*args)

    monkeypatch.setattr(training, "_run_epoch", die_in_epoch_3)
    with pytest.raises(KeyboardInterrupt):
        train(SETTINGS, schedule, part, other_part, resume_folder=tmp_path)
    epochs = []
    monkeypatch.setattr(training, "_run_epoch", lambda *args: epochs.append(args[-1]) or run_epoch(*args))
    resumed, resumed_history = train(SETTINGS, schedule, part, other_part, resume_folder=tmp_path)
    assert epochs == [3]
    assert all(torch.equal(a, b) for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True))
    without_time = [[{k: v for k, v in row.items() if k != "time_s"} for row in h] for h in (history, resumed_history)]
    assert without_time[0] == without_time[1]


def test_other_settings_do_not_resume_a_strangers_state(part, other_part, tmp_path, monkeypatch):
    schedule = dataclasses.replace(SCHEDULE, n_epochs=1, samples_per_epoch=50)
    train(SETTINGS, schedule, part, other_part, resume_folder=tmp_path)
    train(SETTINGS, dataclasses.replace(schedule, momentum=0.8), part, other_part, resume_folder=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_fine_tuning_starts_from_the_given_weights(part, other_part):
    first, _ = train(SETTINGS, dataclasses.replace(SCHEDULE, n_epochs=6), part, other_part)
    short = dataclasses.replace(SCHEDULE, n_epochs=1, samples_per_epoch=100, learning_rate=0.001)
    _, tuned = train(SETTINGS, short, part, other_part, initial=first)
    _, fresh = train(SETTINGS, short, part, other_part)
    assert tuned[0]["validation_loss"] < fresh[0]["validation_loss"]
    with pytest.raises(BadInput, match="other settings"):
        train(dataclasses.replace(SETTINGS, count_scale="raw"), short, part, other_part, initial=first)


def test_a_loss_that_is_no_number_is_an_error(part, other_part):
    with pytest.raises(BadInput, match="learning rate"):
        train(SETTINGS, dataclasses.replace(SCHEDULE, learning_rate=1e30), part, other_part)


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_epochs": 0},
        {"samples_per_epoch": 0},
        {"patch_voxels": 24},
        {"learning_rate": 0.0},
        {"momentum": 1.0},
        {"max_gradient": 0.0},
        {"lr_factor": 1.0},
        {"thinning": 0.0},
        {"class_power": -1.0},
    ],
)
def test_impossible_schedules_are_refused(wrong):
    with pytest.raises(BadInput):
        Schedule(**wrong)


def test_samples_must_fit_the_grid_and_the_network(part):
    strangers = Samples(np.array([[500, 0, 0]], np.int32), np.zeros(1, np.uint8))
    with pytest.raises(BadInput, match="does not have"):
        Part(part.grid, strangers, SETTINGS, 9)
    with pytest.raises(BadInput, match=r"0\.2 m"):
        Part(part.grid, part.samples, dataclasses.replace(SETTINGS, size_m=0.2), 9)


def test_sample_files_are_checked(tmp_path):
    path = tmp_path / "samples.npz"
    good = {"keys": np.zeros((2, 3), np.int32), "labels": np.array([0, 8], np.uint8)}
    np.savez(path, **good)
    assert len(Samples.load(path)) == 2
    for wrong in ({"labels": np.array([0, 255], np.uint8)}, {"labels": np.zeros(3, np.uint8)}):
        np.savez(path, **(good | wrong))
        with pytest.raises(BadInput, match="samples"):
            Samples.load(path)
    path.write_bytes(b"PK")
    with pytest.raises(BadInput):
        Samples.load(path)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_a_gpu_repeats_its_training(part, other_part):
    a, b = (train(SETTINGS, SCHEDULE, part, other_part, device="cuda")[0].state_dict() for _ in range(2))
    assert all(torch.equal(a[name], b[name]) for name in a)
