"""The specifications that come with the project, and what decides where runs are made."""

from pathlib import Path

import pytest

from lio_jax.ablation import cluster
from lio_jax.ablation.spec import load_spec

FOLDER = Path(__file__).parents[2] / "configs" / "ablations"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_specification_is_valid(path, monkeypatch):
    monkeypatch.setenv("KITTI_ODOMETRY", "/data/kitti")
    monkeypatch.setenv("KITTI_RAW", "/data/kitti_raw")
    spec = load_spec(path)
    assert len(spec.variants) > 1
    assert spec.sources


def test_smoke_is_two_drives_by_four_settings():
    spec = load_spec(FOLDER / "smoke.yaml")
    assert len({source.name for source in spec.sources}) == 2
    assert len(spec.variants) == 4
    assert spec.baseline.overrides == {"params.map.voxel_size": 1.2, "params.registration.kernel": 0.1}


def test_a_worker_for_each_gpu_that_jax_would_use(monkeypatch):
    for name in ("JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: name == "jax_cuda13_plugin")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    assert cluster.visible_gpus() == ["3", "5"]
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert cluster.visible_gpus() == []
    monkeypatch.setenv("JAX_PLATFORMS", "cuda,cpu")
    assert cluster.visible_gpus() == ["3", "5"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert cluster.visible_gpus() == []
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    assert cluster.visible_gpus() == []
