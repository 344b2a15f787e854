"""Reverse mode against forward mode, on a recipe of a few lines, wherever the checkpoints are."""

import dataclasses
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import NavState, Scan, initial_nav_state
from lio_jax.recipes import recipe
from lio_jax.run.scan_inputs import ScanInput
from lio_jax.tuning.objectives import TruePose
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.reverse import TotalGradient, checkpointed_gradient
from lio_jax.tuning.streaming import streaming_gradient
from tests.params import default_params
from tests.tuning.recordings import drive

SCANS, EMPTY = 11, (0, 3)


class State(recipe.State):
    nav: NavState
    map: Any
    speed: Any

    def with_velocity_of(self, found):
        return eqx.tree_at(lambda state: state.speed, self, found.speed)


@dataclass(frozen=True)
class Recipe:
    def init(self, params, imu=None):
        return State(initial_nav_state(jaxlie.SE3.identity()), jnp.zeros(2), params.imu.gyro_noise * 100)

    def step(self, params, state, scan, imu=None):
        speed = jnp.sin(state.speed * 3 + params.imu.accel_noise * 50 + scan.points[0, 0])
        speed += params.lidar.range_sigma * state.speed
        velocity = state.nav.velocity + speed * params.imu.gyro_noise * 100
        nav = dataclasses.replace(state.nav, velocity=velocity)
        return State(nav, state.map + 1, speed), SimpleNamespace(
            registration=SimpleNamespace(rmse=speed**2, blur=speed**2, status=jnp.int32(0)),
            lost=jnp.array(False),
            covariance=None,
            evidence=None,
            log_evidence=None,
        )


class Objective(eqx.Module):
    def start(self):
        return jnp.zeros(())

    def add(self, sums, seen, truth):
        return sums + seen.rmse + jnp.sum(jnp.cos(seen.nav.velocity)) * seen.params.lidar.range_sigma

    def value(self, sums):
        return sums**2


class Recording:
    def __len__(self):
        return SCANS

    def scan_inputs(self):
        for index in range(SCANS):
            count = 0 if index in EMPTY else 2
            scan = Scan(
                points=np.full((2, 3), 0.1 * index),
                time=np.zeros(2),
                ring=np.zeros(2, int),
                intensity=np.zeros(2),
                mask=np.arange(2) < count,
                duration=np.float64(0.1),
                interval=np.float64(0.1),
            )
            yield ScanInput(index, index, count, False, count > 0, scan, None, None, None, 0.0, 0.0)

    def truth_at(self, end_ns):
        return TruePose(jaxlie.SE3.identity(), jnp.array(False))


@pytest.mark.parametrize("every", [None, 1, 2, 3, 9])
def test_reverse_mode_gives_the_numbers_of_forward_mode(every):
    free = free_parameters(default_params(), ["imu.gyro_noise", "imu.accel_noise", "lidar.range_sigma"])
    about = Recipe(), free, Objective(), free.first(), Recording()
    forward, backward = streaming_gradient(*about), checkpointed_gradient(*about, every)
    assert backward.value == pytest.approx(forward.value, rel=1e-12)
    np.testing.assert_allclose(backward.gradient, forward.gradient, rtol=1e-10)
    assert np.all(forward.gradient != 0)


@pytest.mark.parametrize(
    ("mode", "most", "expected"), [("auto", 3, "forward"), ("auto", 2, "reverse"), ("reverse", 3, "reverse")]
)
def test_the_mode_follows_the_number_of_parameters(monkeypatch, mode, most, expected):
    from lio_jax.tuning import gradient as module

    def taken(name):
        def differentiate(recipe, free, *_, through_map):
            return TotalGradient({"forward": 1.0, "reverse": 2.0}[name], np.zeros(len(free.names)), ())

        return differentiate

    monkeypatch.setattr(module, "streaming_gradient", taken("forward"))
    monkeypatch.setattr(module, "checkpointed_gradient", taken("reverse"))
    monkeypatch.setattr(module, "_MOST_FORWARD", most)
    found = module.gradient(drive(), ["extrinsics.translation"], "map", count=2, mode=mode)
    assert found.value == {"forward": 1.0, "reverse": 2.0}[expected]
    assert found.through_map
