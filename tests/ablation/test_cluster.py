"""The workers of an ablation listen to this computer only."""

from lio_jax.ablation.cluster import on_this_machine
from tests.network import check_loopback_only, listening


def test_scheduler_and_workers_listen_on_loopback_only():
    before = listening()
    with on_this_machine(1):
        opened = listening() - before
        # the scheduler and its page, the nanny, and the worker
        assert len(opened) >= 4
        check_loopback_only(opened)
    assert not opened & listening()
