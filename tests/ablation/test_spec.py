"""What a specification may say, and one sentence for each mistake in it."""

import pytest

from lio_jax.ablation.sources import Recorded, braces
from lio_jax.ablation.spec import load_spec
from lio_jax.ablation.tasks import pieces, tasks_of
from lio_jax.core.errors import UsageError
from tests.ablation.drives import DRIVE, GRID, write_spec


def spec_of(tmp_path, **changes):
    return load_spec(write_spec(tmp_path / "spec.yaml", **changes))


def message_of(tmp_path, **changes):
    with pytest.raises(UsageError) as caught:
        spec_of(tmp_path, **changes)
    message = str(caught.value)
    assert str(tmp_path / "spec.yaml") in message
    assert "\n" not in message
    return message


def test_grid_takes_all_combinations(tmp_path):
    found = [variant.overrides for variant in spec_of(tmp_path).variants]
    wanted = [(size, kernel) for size in (0.8, 1.2) for kernel in (0.1, 0.3)]
    assert [tuple(overrides.values()) for overrides in found] == wanted


def test_zip_goes_through_its_lists_together(tmp_path):
    found = [tuple(variant.overrides.values()) for variant in spec_of(tmp_path, grid=None, zip=GRID).variants]
    assert found == [(0.8, 0.1), (1.2, 0.3)]


def test_random_draws_are_within_their_ranges_and_the_same_each_time(tmp_path):
    tree = {
        "count": 50,
        "seed": 3,
        "params.imu.gyro_noise": {"log_uniform": [1e-4, 1e-2]},
        "params.map.voxel_size": {"uniform": [0.5, 1.5]},
        "config.imu.use": {"choice": [True, False]},
    }
    first, second = (spec_of(tmp_path, grid=None, random=tree) for _ in range(2))
    assert [v.overrides for v in first.variants] == [v.overrides for v in second.variants]
    noise = [variant.settings.values["imu"]["gyro_noise"] for variant in first.variants]
    assert 1e-4 <= min(noise) < 4e-4
    assert 3e-3 < max(noise) <= 1e-2
    sizes = [variant.settings.values["map"]["voxel_size"] for variant in first.variants]
    assert 0.5 <= min(sizes) < max(sizes) <= 1.5
    assert {variant.settings.config.imu.use for variant in first.variants} == {True, False}


def test_a_recipe_brings_its_own_values_and_set_holds_for_all(tmp_path):
    tree = [{"name": "ours"}, {"recipe": "loam"}, {"recipe": "loam", "params.map.voxel_size": 0.5}]
    ours, loam, finer = spec_of(tmp_path, grid=None, list=tree).variants
    assert (ours.name, loam.name, finer.name) == ("ours", "recipe=loam", "recipe=loam voxel_size=0.5")
    assert loam.settings.recipe == "loam"
    assert loam.settings.values["map"]["voxel_size"] == 0.8
    assert not hasattr(loam.settings.config, "imu")
    assert all(one.settings.config.map.capacity == 16384 for one in (ours, loam, finer))


def test_a_settings_file_beside_the_specification(tmp_path):
    (tmp_path / "mine.yaml").write_text("recipe: fast_lio2\nparams: {map: {voxel_size: 0.7}}\n")
    (variant,) = spec_of(tmp_path, recipe="mine.yaml", grid=None, list=[{}]).variants
    assert (variant.name, variant.settings.recipe) == ("mine", "fast_lio2")
    assert variant.settings.values["map"]["voxel_size"] == 0.7


def test_baseline_is_compared_first_and_added_where_it_is_missing(tmp_path):
    spec = spec_of(tmp_path, baseline={"params.map.voxel_size": 1.2, "params.registration.kernel": 0.1})
    assert len(spec.variants) == 4
    assert spec.baseline is spec.variants[0]
    assert spec.baseline.name == "voxel_size=1.2 kernel=0.1"
    assert len(spec_of(tmp_path, baseline={}).variants) == 5


def test_the_same_settings_are_run_once(tmp_path):
    assert len(spec_of(tmp_path, grid={"params.map.voxel_size": [0.8, 1.2, 0.8, "1.2"]}).variants) == 2


def test_seeds_are_of_simulated_drives_only(tmp_path):
    sources = spec_of(tmp_path, sequences=[DRIVE, {"path": "a/{00..02}"}], seeds=[4, 5]).sources
    assert [(source.name, source.seed) for source in sources] == [
        ("street", 4),
        ("street", 5),
        *((f"0{number}", None) for number in range(3)),
    ]
    assert sources[2].path == str(tmp_path / "a" / "00")


def test_variables_and_braces_in_paths(tmp_path, monkeypatch):
    monkeypatch.setenv("KITTI_HERE", "/data")
    entry = {"path": "$KITTI_HERE/{00,07}", "truth": "$KITTI_HERE/t{00,07}.tum", "scans": 9}
    first, second = spec_of(tmp_path, sequences=[entry]).sources
    assert first == Recorded("00", "/data/00", "/data/t00.tum", 0, 9)
    assert second.truth_file == "/data/t07.tum"
    assert braces("a{1..3}b{x,y}") == ["a1bx", "a1by", "a2bx", "a2by", "a3bx", "a3by"]


MISTAKES = {
    "nothing to compare": {"grid": None},
    "grid: is empty": {"grid": {}},
    "params.map.voxel_size = [] must be a list": {"grid": {"params.map.voxel_size": []}},
    "params.map.voxel_size = 1.0 must be a list": {"grid": {"params.map.voxel_size": 1.0}},
    "unknown key 'params.map.voxl_size'; did you mean 'params.map.voxel_size'": {
        "grid": {"params.map.voxl_size": [1.0]}
    },
    "must be greater than zero": {"grid": {"params.map.voxel_size": [1.0, -1.0]}},
    "unknown key 'gird'; did you mean 'grid'": {"gird": GRID},
    "unknown key 'duratoin'; did you mean 'duration'": {"sequences": [{"sim": "street", "duratoin": 1}]},
    "recipe 'lome' is not known": {"recipe": "lome"},
    "world 'strete' is unknown": {"sequences": [{"sim": "strete"}]},
    "sensor 'vlp' is unknown": {"sequences": [{"sim": "street", "sensor": "vlp"}]},
    "duration = 'long' must be a number": {"sequences": [{"sim": "street", "duration": "long"}]},
    "must hold either path": {"sequences": [{"name": "x"}]},
    "sequences must be a list": {"sequences": None},
    "two sequences are named 'street'": {"sequences": [DRIVE, DRIVE]},
    "unknown metric 'ate.rms'; did you mean 'ate.rmse'": {"metrics": ["ate.rms"]},
    "seeds = [-1]": {"seeds": [-1]},
    "keep = 'nothing' must be one of": {"keep": "nothing"},
    "batch = 0 must be auto": {"batch": 0},
    "all keys need as many values": {"zip": {"params.map.voxel_size": [1], "params.map.reach": [50, 60]}},
    "count = 0 must be": {"random": {"params.map.voxel_size": {"uniform": [1, 2]}}},
    "must be {uniform": {"random": {"count": 1, "params.map.voxel_size": {"log_uniform": [0, 2]}}},
    "two different entries are named 'a'": {"list": [{"name": "a"}, {"name": "a", "recipe": "loam"}]},
    "the environment variable NOT_SET_ANYWHERE is not set": {"sequences": [{"path": "$NOT_SET_ANYWHERE/0"}]},
    "truth names 1 files for 2": {"sequences": [{"path": "{a,b}", "truth": "t"}]},
}


@pytest.mark.parametrize("wanted", MISTAKES)
def test_mistakes(tmp_path, wanted):
    changes = MISTAKES[wanted]
    if "recipe" in changes:
        with pytest.raises(UsageError, match=wanted):
            spec_of(tmp_path, **changes)
    else:
        assert wanted in message_of(tmp_path, **changes)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(UsageError, match=r"none\.yaml: the specification cannot be read"):
        load_spec(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("grid: {")
    with pytest.raises(UsageError, match=r"bad\.yaml: not valid YAML"):
        load_spec(tmp_path / "bad.yaml")


def test_a_task_is_named_by_what_its_result_depends_on(tmp_path):
    def keys(**changes):
        return [task.key for task in tasks_of(spec_of(tmp_path, **changes))]

    known = keys()
    assert len(set(known)) == 4
    assert keys() == known
    assert keys(metrics=["rpe.rmse"], batch=4, name="other") == known
    assert set(keys(grid={**GRID, "params.map.reach": [120.0, 60.0]})).isdisjoint(known)
    assert set(keys(seeds=[1])).isdisjoint(known)
    assert set(keys(keep="everything")).isdisjoint(known)
    reordered = dict(reversed(GRID.items()))
    assert sorted(keys(grid=reordered)) == sorted(known)


def test_a_recording_that_changes_is_run_anew(tmp_path):
    data = tmp_path / "data"
    data.mkdir()
    file = data / "scan.bin"
    file.write_bytes(b"1234")

    def key():
        return tasks_of(spec_of(tmp_path, sequences=[{"path": "data"}]))[0].key

    before = key()
    moved = tmp_path / "elsewhere"
    data.rename(moved)
    assert key() != before
    moved.rename(data)
    assert key() == before
    file.write_bytes(b"12345")
    assert key() != before


def test_runs_that_share_a_program_go_to_one_worker(tmp_path):
    changes = {"grid": {"config.imu.use": [True, False], "params.map.voxel_size": [0.8, 1.0, 1.2]}}
    tasks = tasks_of(spec_of(tmp_path, seeds=[0, 1], **changes))
    found = pieces(tasks, workers=2)
    assert [len(piece) for piece in found] == [3, 3, 3, 3]
    assert all(len({task.settings.config for task in piece}) == 1 for piece in found)
    # one recording alone is shared out
    assert [len(piece) for piece in pieces(tasks[:3], workers=2)] == [2, 1]
