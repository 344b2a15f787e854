"""How a run begins: what the second scan shows of the motion compensates the first scan anew."""

from typing import Any, Protocol, runtime_checkable

from lio_jax.core.types import ImuBatch, Scan


@runtime_checkable
class Stepper(Protocol):
    """What takes an estimate from scan to scan; its state is a recipe's, or a transformed recipe's."""

    def init(self, imu: ImuBatch | None) -> Any:
        """Return the state before the first scan; ``imu``: samples up to its end, or None."""
        ...

    def step(self, state: Any, scan: Scan, imu: ImuBatch | None) -> tuple[Any, Any]:
        """Return state and output after a scan; ``state`` is consumed."""
        ...


@runtime_checkable
class StepInput(Protocol):
    """One scan as a stepper takes it."""

    @property
    def scan(self) -> Scan:
        """Return the padded sweep."""
        ...

    @property
    def imu(self) -> ImuBatch | None:
        """Return the samples that cover it."""
        ...

    @property
    def before(self) -> ImuBatch | None:
        """Return the samples up to its end, for a start here."""
        ...


def reopened(stepper: Stepper, state: Any, first: StepInput, second: StepInput) -> Any:
    """Return the state after the first scan, compensated with the velocity that the second one shows.

    Only the second scan tells how fast a vehicle is moving from the start; until then the map holds the first
    scan distorted.

    Args:
        stepper: of the run.
        state: after the first scan; it is consumed.
        first: the first scan with points.
        second: the next one with points.
    """
    if first.scan.duration == 0 or first.scan.points.shape != second.scan.points.shape:
        return state
    found, _ = stepper.step(state, second.scan, second.imu)
    return stepper.step(stepper.init(first.before).with_velocity_of(found), first.scan, first.imu)[0]
