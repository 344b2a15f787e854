"""The results of a worker: alone or in a batch, in any order, and after an error."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from lio_jax.ablation import perform as performing
from lio_jax.ablation.batch import run_batch
from lio_jax.ablation.perform import perform
from lio_jax.ablation.spec import METRICS, load_spec
from lio_jax.ablation.store import DiskError, gathered, opened
from lio_jax.ablation.tasks import tasks_of
from lio_jax.commands.runtime import prepare_jax
from lio_jax.core.errors import LioJaxError
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.track import scan_inputs, track
from tests.ablation.drives import DRIVE, SMALL, write_spec
from tests.full_disk import full_disk_after

COLUMNS = [name for name, unit in METRICS.items() if unit not in ("ms", "s")]
"""What does not differ from run to run on one machine."""


def performed(root, tasks):
    """Do the tasks in this process and return the store."""
    prepare_jax()
    with opened(root) as store:
        perform(tuple(tasks), store)
    return store


def table(store, tasks):
    return gathered(store, tasks, COLUMNS)


DENSE = {
    "config.lidar.buckets": [8192],
    "config.imu.registration_points": 2048,
    "config.imu.insertion_points": 4096,
    "config.map.capacity": 32768,
    # else rounding decides now and then whether there is one iteration more
    "params.registration.rotation_tolerance": 1e-12,
    "params.registration.translation_tolerance": 1e-12,
}
STANDING = {**DRIVE, "beams": 16, "columns": 512}
"""Before it pulls away: farther on rounding carries points over the borders of voxels, in any program."""


def in_double_precision(settings, scans, imu):
    """Feed points in double precision: in single precision a micrometre is lost at 16 m already."""
    for fed in scan_inputs(settings, scans, imu):
        wide = {name: np.asarray(getattr(fed.scan, name), np.float64) for name in ("points", "time")}
        ends = {name: np.float64(getattr(fed.scan, name)) for name in ("duration", "interval")}
        yield replace(fed, scan=replace(fed.scan, **wide, **ends))


def test_a_batch_equals_the_runs_one_by_one(tmp_path, monkeypatch):
    monkeypatch.setattr("lio_jax.ablation.batch.scan_inputs", in_double_precision)
    monkeypatch.setattr("lio_jax.run.track.scan_inputs", in_double_precision)
    prepare_jax()
    tasks = tasks_of(
        load_spec(write_spec(tmp_path / "spec.yaml", set={**SMALL, **DENSE}, sequences=[STANDING]))
    )
    sequence = tasks[0].source.open(tasks[0].settings.run.data)
    settings = [settings_for(sequence, one.settings)[0] for one in tasks]
    batched = run_batch(sequence, settings)
    ends = set()
    for own, run in zip(settings, batched, strict=True):
        imu, _ = imu_feed(sequence, own)
        alone = list(track(own, sequence.scans(), imu))
        assert [one.failure for one in alone if one.failure] == [
            failure["message"].split(": ", 1)[1] for failure in run.metrics["failures"]
        ]
        poses = np.stack([one.T_world_imu for one in alone])
        np.testing.assert_allclose(run.trajectory.poses, poses, rtol=0, atol=1e-6)
        ends.add(poses[-1].tobytes())
    # four settings, four results
    assert len(ends) == 4


@pytest.mark.long
def test_a_batch_leaves_what_the_runs_one_by_one_leave(tmp_path):
    """Points agree as recorded, in single precision at their range."""
    tables, names = [], []
    for batch in (1, 3):
        tasks = tasks_of(load_spec(write_spec(tmp_path / "spec.yaml", batch=batch)))
        store = performed(tmp_path / str(batch), tasks)
        assert not store.failed(task.key for task in tasks)
        tables.append(table(store, tasks))
        names.append([{file.name for file in store.folder(task.key).iterdir()} for task in tasks])
        manifests = [json.loads((store.folder(task.key) / "manifest.json").read_text()) for task in tasks]
        assert [manifest["batch"] for manifest in manifests] == ([1] * 4 if batch == 1 else [3, 3, 3, 1])
        if batch == 1:
            assert [manifest["timings"]["compile_s"] for manifest in manifests[1:]] == [0, 0, 0]
    assert names[0] == names[1]
    for name in COLUMNS:
        ours, theirs = (np.array(one[name].to_pylist(), float) for one in tables)
        np.testing.assert_allclose(ours, theirs, atol=_SINGLE_M, rtol=1e-3, err_msg=name)
    # eight beams leave few planes, and the drive is not lost; measured: 0.013 m
    assert max(tables[0]["ate.rmse"].to_pylist()) < 0.05


_SINGLE_M = 100.0 * 2**-23
"""Spacing of single-precision numbers at the largest range, m."""


def test_the_order_does_not_matter(tmp_path):
    tasks = tasks_of(load_spec(write_spec(tmp_path / "spec.yaml")))
    forward = table(performed(tmp_path / "a", tasks), tasks)
    backward = table(performed(tmp_path / "b", tasks[::-1]), tasks)
    assert forward.num_rows == 4
    assert forward.equals(backward)


def test_what_a_run_leaves_behind(tmp_path, monkeypatch):
    spec = load_spec(write_spec(tmp_path / "spec.yaml", grid={"params.map.voxel_size": [0.8]}))
    (task,) = tasks_of(spec)
    folder = performed(tmp_path / "out", [task]).folder(task.key)
    assert {file.name for file in folder.iterdir()} == {
        *("trajectory.tum", "metrics.json", "config.yaml"),
        *("result.parquet", "manifest.json"),
    }
    row = pq.read_table(folder / "result.parquet").to_pylist()[0]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert row["ate.rmse"] == metrics["ate"]["rmse"] > 0
    assert (row["sequence"], row["seed"], row["params.map.voxel_size"]) == ("street", 0, 0.8)
    assert row["scans"] == 10
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["key"] == task.key
    assert {"python", "jax", "jaxlib", "numpy", "lio-jax"} == set(manifest["versions"])

    def again(*_args, **_kept):
        raise AssertionError("a finished run was begun again")

    monkeypatch.setattr(performing, "_alone", again)
    performed(tmp_path / "out", [task])


def test_a_failure_is_recorded_and_others_go_on(tmp_path, monkeypatch):
    tasks = tasks_of(load_spec(write_spec(tmp_path / "spec.yaml")))
    original = performing.run_sequence

    def breaking(sequence, settings, *rest, **kept):
        if settings.values["registration"]["kernel"] == 0.3 and settings.values["map"]["voxel_size"] == 0.8:
            raise LioJaxError("the second one is not wanted.")
        if settings.values["map"]["voxel_size"] == 0.8:
            raise ZeroDivisionError("division by zero")
        return original(sequence, settings, *rest, **kept)

    monkeypatch.setattr(performing, "run_sequence", breaking)
    store = performed(tmp_path / "out", tasks)
    keys = [task.key for task in tasks]
    assert store.failed(keys) == keys[:2]
    assert store.done(keys) == keys[2:]
    first, second = (store.reason(key) for key in keys[:2])
    assert first["reason"] == "unexpected ZeroDivisionError: division by zero."
    assert "in breaking" in first["traceback"]
    assert second == {
        "run": "street seed 0, voxel_size=0.8 kernel=0.3",
        "reason": "the second one is not wanted.",
        "traceback": "",
    }
    # they are left alone until that is asked for
    monkeypatch.setattr(performing, "run_sequence", original)
    assert performed(tmp_path / "out", tasks).failed(keys) == keys[:2]
    store.forget_failures(keys)
    assert performed(tmp_path / "out", tasks).done(keys) == keys


def test_a_full_disk_ends_it_all(tmp_path):
    tasks = tasks_of(load_spec(write_spec(tmp_path / "spec.yaml")))
    prepare_jax()
    with (
        opened(tmp_path / "out") as store,
        full_disk_after(200),
        pytest.raises(DiskError, match="cannot be written") as caught,
    ):
        perform(tuple(tasks), store)
    assert str(store.folder(tasks[0].key)) in str(caught.value)
    assert not list((tmp_path / "out" / "tasks").iterdir())
    assert not (tmp_path / "out" / "failed").exists()
