"""Each kind of bag that cannot be read says in one sentence which file is at fault and what to do."""

from pathlib import Path

import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.bag_files import bag_paths, open_bag
from tests.data import bags


def _fault(path: Path) -> str:
    """Return the message that opening raises."""
    with pytest.raises(LioJaxError) as caught, open_bag(bag_paths(path)):
        pass
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path.parent))
    return message


def _cut(path: Path, fraction: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    return path


def _storage(folder: Path) -> Path:
    return next(file for file in folder.iterdir() if file.suffix in (".db3", ".mcap"))


def test_nothing_there(tmp_path: Path) -> None:
    assert "no such file or folder" in _fault(tmp_path / "none.bag")


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_an_empty_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.touch()
    assert "is empty (0 bytes)" in _fault(path)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_something_else_under_the_name_of_a_bag(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"PK\x03\x04 this is an archive")
    assert f"not a ROS bag, although its name ends in {suffix}" in _fault(path)


def test_another_kind_of_file_and_folder(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(b"1234")
    assert "not a ROS bag; one ends in .bag, .mcap or .db3" in _fault(path)
    (tmp_path / "folder").mkdir()
    assert "holds neither metadata.yaml nor .bag" in _fault(tmp_path / "folder")


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.7, 0.95, 0.999])
def test_a_truncated_ros1_bag(tmp_path: Path, fraction: float) -> None:
    path = _cut(bags.write_bag(tmp_path / "a.bag", bags.velodyne_messages(20, ros2=False)), fraction)
    message = _fault(path)
    assert "a.bag: the bag was not closed properly or is truncated (" in message
    assert "run 'rosbag reindex a.bag'" in message


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.7, 0.95, 0.999])
def test_a_truncated_mcap(tmp_path: Path, fraction: float) -> None:
    path = _cut(_storage(bags.write_bag(tmp_path / "a.mcap", bags.velodyne_messages(20))), fraction)
    message = _fault(path)
    assert "a.mcap: the bag was not closed properly or is truncated (" in message
    assert "run 'mcap recover a.mcap'" in message


@pytest.mark.parametrize("fraction", [0.3, 0.7])
def test_a_truncated_database(tmp_path: Path, fraction: float) -> None:
    path = _cut(_storage(bags.write_bag(tmp_path / "a.db3", bags.velodyne_messages(20))), fraction)
    message = _fault(path)
    assert "a.db3: the bag was not closed properly or is truncated (" in message
    assert "run 'ros2 bag reindex a'" in message


def test_a_folder_whose_storage_is_missing(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "a.db3", bags.velodyne_messages(2))
    _storage(folder).unlink()
    assert "the bag folder is incomplete" in _fault(folder)


def test_a_bag_that_is_still_being_recorded(tmp_path: Path) -> None:
    path = tmp_path / "a.bag.active"
    path.write_bytes(b"#ROSBAG V2.0\n")
    for where in (path, tmp_path):
        with pytest.raises(LioJaxError, match=r"a\.bag\.active: the bag was not closed properly"):
            bag_paths(where)


def test_the_damaged_one_of_several_split_bags_is_named(tmp_path: Path) -> None:
    for number in range(3):
        bags.write_bag(
            tmp_path / f"split_{number}.bag", bags.velodyne_messages(3, ros2=False, first=3 * number)
        )
    _cut(tmp_path / "split_1.bag", 0.6)
    with (
        pytest.raises(LioJaxError, match=r"split_1\.bag: the bag was not closed properly"),
        open_bag(bag_paths(tmp_path)),
    ):
        pass


def test_an_empty_folder_named_like_a_bag(tmp_path: Path) -> None:
    (tmp_path / "a.bag").mkdir()
    assert "holds neither" in _fault(tmp_path / "a.bag")
