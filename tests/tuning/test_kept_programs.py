"""Programs are compiled once a process: other parameter values and other recordings compile nothing."""

from functools import cache

import numpy as np
import pytest

from lio_jax.core.xla import forget_programs, programs
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.run import imu_feed
from lio_jax.run.track import track
from lio_jax.settings.settings import Settings, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from lio_jax.tuning.gradient import Loss, gradient
from lio_jax.tuning.objectives import MeanOverScans, RelativeError, WeightedSum, pose_innovation
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.recording import Recording
from tests.compilations import compilations
from tests.tuning.recordings import drive, settings

FREE = ["imu.*_noise", "extrinsics.translation"]
COUNT = 5
POSE = MeanOverScans(pose_innovation)


@cache
def chosen() -> Settings:
    return settings("default", True)


@cache
def other_values() -> Settings:
    return with_overrides(chosen(), ["params.imu.gyro_noise=0.004", "params.registration.kernel=0.25"])


@cache
def other_drive() -> SimulatedSequence:
    return SimulatedSequence(duration_s=1.0, beams=16, columns=256, seed=4, imu=ImuModel())


@pytest.mark.long
def test_a_second_gradient_compiles_nothing():
    first = gradient(drive(), FREE, POSE, chosen(), count=COUNT)
    # simulating compiles, too
    read = Recording(other_drive(), chosen(), 0, COUNT)
    assert len(read) == COUNT
    with compilations() as compiled:
        again = gradient(drive(), FREE, POSE, chosen(), count=COUNT)
        values = gradient(drive(), FREE, POSE, other_values(), count=COUNT)
        recording = gradient(other_drive(), FREE, POSE, chosen(), count=COUNT)
    assert not compiled
    assert again == first
    assert len({first.value, values.value, recording.value}) == 3


@pytest.mark.long
def test_other_parameters_and_objectives_have_programs_of_their_own():
    gradient(drive(), FREE, POSE, chosen(), count=COUNT)
    with compilations() as compiled:
        gradient(drive(), FREE, "map", chosen(), count=COUNT)
    # what adds a scan, and what makes a value of the sums; the steps are there
    assert len(compiled) == 2
    with compilations() as compiled:
        gradient(drive(), ["imu.*_noise"], POSE, chosen(), count=COUNT)
    assert len(compiled) >= 4


@pytest.mark.long
def test_a_second_evaluation_of_a_tuning_compiles_nothing():
    free = free_parameters(chosen().params(), FREE)
    elsewhere = free_parameters(other_values().params(), FREE)
    recording = Recording(drive(), chosen(), 0, COUNT)
    x = np.asarray(free.first())
    loss = Loss("default", chosen().config, free, POSE)
    before = loss(x, [recording]).value, loss.values(x[None], recording)[0]
    with compilations() as compiled:
        loss = Loss("default", chosen().config, elsewhere, POSE)
        after = loss(x + 0.1, [recording]).value, loss.values(x[None] + 0.1, recording)[0]
    assert not compiled
    assert before[0] != after[0]
    assert before[1] != after[1]


def test_a_second_run_compiles_nothing():
    imu = imu_feed(drive(), chosen())[0]
    first = [item.T_world_imu for item in track(chosen(), drive().scans(0, COUNT), imu)]
    step = CompiledStep(other_values())
    with compilations() as compiled:
        second = [item.T_world_imu for item in track(other_values(), drive().scans(0, COUNT), imu, step)]
    assert not compiled
    assert step.compile_s == 0
    assert not np.array_equal(first, second)


def _twice(static, x):
    return x * static.weights[0] if isinstance(static, WeightedSum) else 2 * x


def test_objectives_are_equal_by_what_they_are():
    weighted = [WeightedSum((RelativeError(scans), MeanOverScans(np.sum)), (0.5, 1.0)) for scans in (3, 3, 4)]
    same, equal, different = (programs(_twice, objective) for objective in weighted)
    assert same is equal
    assert same is not different


class Unhashable:
    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other):
        return True


def test_what_has_no_hash_equals_only_itself():
    one, other = Unhashable(), Unhashable()
    assert programs(_twice, one) is programs(_twice, one)
    assert programs(_twice, one) is not programs(_twice, other)


def test_forgotten_programs_are_compiled_anew():
    held, ones = programs(_twice, "forgotten"), np.ones(3)
    np.testing.assert_array_equal(held(ones), 2.0)
    assert len(held) == 1
    forget_programs()
    assert len(held) == 0
    assert programs(_twice, "forgotten") is not held
    np.testing.assert_array_equal(held(ones), 2.0)
    assert len(held) == 1
