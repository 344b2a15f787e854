"""Stochastic training: its minimum, what judges it, and that a killed one goes on to the same bits."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.tuning.evaluated import Evaluated
from lio_jax.tuning.objectives import MeanOverScans, as_named, objective_named
from lio_jax.tuning.optimise import Bounds
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.train import TRAINING, Schedule, TrainingSession
from tests.params import default_params

FREE = free_parameters(default_params(), ["imu.gyro_noise", "lidar.range_sigma"])
SAMPLES = np.random.default_rng(0).normal(0.0, [0.02, 3.0], (4000, 2)).reshape(20, 200, 2)
BEST = np.log(np.sqrt(np.mean(SAMPLES**2, (0, 1))))
START = BEST + np.log(5.0)
SCHEDULE = Schedule(batch=3, epochs=30, rate=0.2, patience=30)


class Piece:
    """Some samples in place of a recording."""

    def __init__(self, samples, name="drive"):
        self.samples, self.name = samples, name

    def __len__(self):
        return len(self.samples)


class Likelihood:
    """The mean negative log-likelihood of zero-mean samples by their log standard deviations."""

    calls = 0

    def __call__(self, x, pieces):
        self.calls += 1
        rows = np.concatenate([piece.samples for piece in pieces])
        square = rows**2 * np.exp(-2 * np.asarray(x))
        return Evaluated(float(np.mean(np.sum(square / 2 + x, 1))), (1 - square).mean(0), None, 0, len(rows))

    def values(self, xs, piece):
        return np.array([self(x, [piece]).value for x in xs])


def problem(loss=None, judges=(), pieces=SAMPLES, **changed):
    """Return what a training sees of a problem."""
    seen = {
        "free": FREE,
        "loss": loss or Likelihood(),
        "training": tuple(Piece(piece) for piece in pieces),
        "validation": tuple(Piece(piece) for piece in judges),
        "first": lambda: START,
        "bounds": lambda: Bounds(BEST - 7, BEST + 7),
        "tuned_settings": lambda x: np.array(x),
        "named": objective_named("pose"),
        "settings": SimpleNamespace(recipe="default", config=1, values={"imu": {"gravity": 9.8}}),
    }
    return SimpleNamespace(**{**seen, **changed})


def trained(posed, schedule=SCHEDULE, out=None, observer=lambda epoch: None):
    session = TrainingSession(posed, schedule, out)
    session.run(observer)
    return session.trained()


def test_the_minimum_over_all_pieces_is_found():
    found = trained(problem())
    np.testing.assert_allclose(found.settings, BEST, atol=0.02)
    assert len(found.epochs) == 30
    assert found.best == 29


def test_the_recordings_that_judge_choose_the_epoch_and_the_end():
    """They hold samples of twice the size, through which the training passes on its way to the minimum."""
    judges = 2 * SAMPLES[:2]
    found = trained(problem(judges=judges), replace(SCHEDULE, patience=3, rate=0.05))
    losses = [epoch.validation for epoch in found.epochs]
    assert found.best == int(np.argmin(losses)) == len(losses) - 4
    assert 0 < found.best < 20
    again = Likelihood().values(found.settings[None], Piece(judges.reshape(-1, 2)))
    np.testing.assert_allclose(again, min(losses))


@pytest.mark.parametrize("calls", [3, 7, 8, 20])
def test_a_killed_training_goes_on_to_the_same_bits(tmp_path, calls):
    """Seven batches an epoch: it is killed within one, at its end and at the start of another."""

    class Killed(Exception):
        pass

    class Mortal(Likelihood):
        def __call__(self, x, pieces):
            if self.calls == calls:
                raise Killed
            return super().__call__(x, pieces)

    short = replace(SCHEDULE, epochs=4)
    with pytest.raises(Killed):
        trained(problem(Mortal()), short, tmp_path)
    rest = Likelihood()
    seen = []
    found = trained(problem(rest), short, tmp_path, seen.append)
    expected = trained(problem(), short)
    np.testing.assert_array_equal(found.settings, expected.settings)
    assert found.epochs == expected.epochs
    assert tuple(seen) == expected.epochs[calls // 7 :]
    # nothing is done twice
    assert rest.calls == 28 - calls


def test_a_piece_without_a_finite_gradient_changes_nothing():
    broken = SAMPLES.copy()
    broken[4] = np.nan
    found = trained(problem(pieces=broken))
    assert all(epoch.skipped == 1 for epoch in found.epochs)
    np.testing.assert_allclose(found.settings, BEST, atol=0.1)


def test_nothing_but_broken_pieces_is_an_error():
    with pytest.raises(LioJaxError, match="no batch of epoch 1 has a finite loss"):
        trained(problem(pieces=np.full_like(SAMPLES, np.nan)))


def test_a_loss_without_the_parameters_is_an_error():
    class Constant(Likelihood):
        def __call__(self, x, pieces):
            return replace(super().__call__(x, pieces), gradient=np.zeros(2))

    with pytest.raises(LioJaxError, match="does not depend"):
        trained(problem(Constant()))


OTHER = free_parameters(default_params(), ["imu.gyro_noise", "imu.accel_noise"])


def own_loss(observed, truth):
    return observed.rmse


@pytest.mark.parametrize(
    ("changed", "seed", "named"),
    [
        ({"pieces": SAMPLES[:5, :9]}, 0, "recordings, pieces"),
        ({"training": tuple(Piece(piece, "other") for piece in SAMPLES)}, 0, "recordings"),
        ({"validation": (Piece(SAMPLES[0]),)}, 0, "recordings that judge"),
        ({"named": objective_named("pose + ranges")}, 0, r"objective \(it has pose\)"),
        ({"named": as_named(MeanOverScans(own_loss))}, 0, r"objective \(it has pose\)"),
        ({"free": OTHER}, 0, "parameters"),
        (
            {"settings": SimpleNamespace(recipe="loam", config=2, values={})},
            0,
            "values of parameters, recipe, config",
        ),
        ({}, 3, "seed"),
    ],
)
def test_another_training_is_not_continued(tmp_path, changed, seed, named):
    short = replace(SCHEDULE, epochs=1)
    trained(problem(), short, tmp_path)
    with pytest.raises(
        UsageError,
        match=rf"{TRAINING}: is the training of another problem, with other {named}; .*--overwrite",
    ):
        trained(problem(**changed), replace(short, seed=seed), tmp_path)


def test_an_objective_of_ones_own_is_told_from_others_in_any_process():
    def other_loss(observed, truth):
        return observed.rmse

    name = as_named(MeanOverScans(own_loss)).name
    assert name == "MeanOverScans(own_loss, 0)"
    assert as_named(MeanOverScans(other_loss)).name != name != as_named(MeanOverScans(own_loss, 3)).name
    assert as_named("noise").name == as_named("pose + ranges").name == "pose+ranges"


def without(member):
    def damage(path):
        with np.load(path) as held:
            kept = {name: held[name] for name in held.files if name != member}
        with path.open("wb") as file:
            np.savez(file, **kept)

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b"PK\x03\x04 and no more"),
        without("identity"),
        without("best_x"),
        without("epochs"),
    ],
)
def test_a_damaged_training_is_named(tmp_path, damage):
    trained(problem(), replace(SCHEDULE, epochs=1), tmp_path)
    damage(tmp_path / TRAINING)
    with pytest.raises(LioJaxError, match=rf"{TRAINING}: is no training that can be continued"):
        trained(problem(), replace(SCHEDULE, epochs=1), tmp_path)


@pytest.mark.parametrize("wrong", [{"batch": 0}, {"epochs": 0}, {"patience": 0}, {"rate": float("nan")}])
def test_an_impossible_schedule_is_refused(wrong):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Schedule(**wrong)
