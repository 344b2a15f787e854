"""The tests share drives with the benchmark: its modules can be imported from here on."""

from tests.experiments import bench_path  # noqa: F401
