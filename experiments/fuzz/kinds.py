"""The kinds of input: which files are damaged, in which ways, and the command that reads them."""

from dataclasses import dataclass
from pathlib import Path
from random import Random

from experiments.fuzz import mutations
from experiments.fuzz.edits import Edit
from experiments.fuzz.mutations import Draw

_NATIVE = ("export", "{in}/drive", "--to", "native", "--out", "{out}/r")
_KITTI = ("export", "{in}/04", "--to", "native", "--out", "{out}/r")
_PLAIN = ("config.output.recording=false", "config.output.plot=false", "config.output.report=false")
_RUN = ("run", "{in}/drive", "--scans", "3", "--out", "{out}/r", "--set", *_PLAIN)
_TEXT = (mutations.text,) * 6 + (mutations.raw, mutations.whole)
_NPZ = (mutations.array,) * 6 + (mutations.raw, mutations.raw, mutations.whole)
_TREE = (mutations.tree,) * 8 + (mutations.raw, mutations.whole)
_PCAP = (mutations.number("pcap"),) * 6 + (mutations.raw, mutations.raw, mutations.whole)
_ANY = (mutations.fitting,) * 6 + (mutations.raw, mutations.whole)
_COPIED = ("gyro", "accel", "orientation", "position", "covariance", "origin", "intensity")
"""Arrays of a recording that an export copies as they are; a run leaves out what is not finite."""


@dataclass(frozen=True)
class Kind:
    """One kind of input."""

    name: str
    seed: str
    """Folder of the seeds from which an input starts."""
    files: tuple[str, ...]
    """Patterns of the files that are damaged."""
    draws: tuple[Draw, ...]
    """Ways of damage; one is drawn for each edit."""
    commands: tuple[tuple[str, ...], ...]
    """Words of the commands, of which one is drawn; {in} is the input's folder, {out} the one for results."""
    ends: str = ""
    """Regular expression of a refusal that means that this file was accepted.

    For files whose content would start work that takes minutes: the command is given a recording that does
    not exist, or a file where results are to go.
    """
    may_be_nan: tuple[str, ...] = ()
    """Names of results in which a value that is not finite is right."""
    every: int = 1
    """The kind takes part in every so manieth round: its commands take longer than others."""
    compiles: bool = False
    """Whether its commands compile programs of their own before they print anything."""

    def words(self, edits: list[Edit], random: Random) -> tuple[str, ...]:
        """Return the words of a command that reads a damaged file, where only some commands read it."""
        names = {edit.file.rpartition("/")[2] for edit in edits}
        reading = [words for words in self.commands if any(name in " ".join(words) for name in names)]
        return random.choice(reading or self.commands)

    def draw(self, folder: Path, random: Random) -> list[Edit]:
        """Return one to three edits of a seed's folder."""
        files = sorted({path for pattern in self.files for path in folder.glob(pattern)})
        edits: list[Edit] = []
        for _ in range(random.choice((1, 1, 1, 2, 2, 3))):
            file = random.choice(files)
            edits.append(random.choice(self.draws)(folder, str(file.relative_to(folder)), random))
        return edits


def _bag(name: str, seed: str, file: str, layout: str) -> Kind:
    draws = (mutations.number(layout),) * 8 + (mutations.raw, mutations.raw)
    data = f"{{in}}/{file}"
    commands = (("export", data, "--to", "native", "--out", "{out}/r"), ("inspect", data, "--json"))
    return Kind(
        name,
        seed,
        (file,),
        (*draws, mutations.whole) if name == seed else draws,
        (commands[0],) * 4 + (commands[1],),
        may_be_nan=_COPIED,
    )


def _clouds(folder: str, files: str, draws: tuple[Draw, ...]) -> Kind:
    command = ("export", f"{{in}}/{folder}", "--to", "native", "--out", "{out}/r")
    name = f"clouds {folder} {files.partition('.')[2]}"
    return Kind(name, "clouds", (f"{folder}/{files}",), draws, (command,), may_be_nan=_COPIED)


def _capture(sensor: str, file: str, draws: tuple[Draw, ...]) -> Kind:
    data = f"{{in}}/{sensor}/a.pcap"
    commands = (("export", data, "--to", "native", "--out", "{out}/r"), ("inspect", data, "--json"))
    kind = f"{sensor} {file.rpartition('.')[2]}"
    return Kind(
        kind,
        "captures",
        (f"{sensor}/{file}",),
        draws,
        (commands[0],) * 4 + (commands[1],),
        may_be_nan=_COPIED,
    )


_NOWHERE = r"nowhere: no such file or folder"

KINDS = (
    _bag("ros1", "ros1", "a.bag", "ros1"),
    _bag("messages", "ros1", "a.bag", "messages"),
    _bag("livox", "livox", "a.bag", "messages"),
    _bag("ouster", "ouster", "a.bag", "messages"),
    _bag("parts", "parts", "a.bag", "messages"),
    _bag("mcap", "mcap", "a.mcap", "mcap"),
    _bag("sqlite", "sqlite", "a.db3", "sqlite"),
    Kind(
        "npz",
        "native",
        ("drive/**/*.npz",),
        _NPZ,
        (_NATIVE,) * 3 + (("inspect", "{in}/drive", "--json"),),
        may_be_nan=_COPIED,
    ),
    Kind("run", "native", ("drive/**/*.npz",), (mutations.sound_array,), (_RUN,), every=5),
    Kind(
        "run settings",
        "native",
        ("my.yaml",),
        (mutations.tree,),
        ((*_RUN, "--recipe", "{in}/my.yaml"),),
        every=50,
        compiles=True,
    ),
    Kind(
        "rest",
        "rest",
        ("imu.npz",),
        (*_NPZ, mutations.sound_array),
        (("calibrate-imu", "{in}/imu.npz", "--out", "{out}/r.yaml"),),
        every=2,
    ),
    Kind("meta.yaml", "native", ("drive/meta.yaml",), _TREE, (_NATIVE,)),
    Kind(
        "truth.tum",
        "native",
        ("drive/truth.tum",),
        _TEXT,
        (_NATIVE, ("eval", "{in}/drive/truth.tum", "{in}/drive")),
    ),
    Kind("kitti", "kitti", ("04/*.txt",), _TEXT, (_KITTI, ("eval", "{in}/04/poses.txt", "{in}/04"))),
    Kind(
        "kitti scans",
        "kitti",
        ("04/velodyne/*",),
        (mutations.raw, mutations.whole),
        (_KITTI,),
        may_be_nan=_COPIED,
    ),
    Kind(
        "kitti raw",
        "kitti_raw",
        ("day/*.txt", "day/drive/*/*.txt", "day/drive/*/data/*"),
        _TEXT,
        (("export", "{in}/day/drive", "--to", "native", "--out", "{out}/r"),),
        may_be_nan=_COPIED,
    ),
    _clouds("binary", "*.pcd", (mutations.raw, mutations.raw, mutations.whole)),
    _clouds("compressed", "*.pcd", (mutations.raw, mutations.raw, mutations.whole)),
    _clouds("text", "*.pcd", _TEXT),
    _clouds("text", "*.txt", _TEXT),
    _clouds("text", "*.csv", _TEXT),
    _clouds("text", "*.tum", _TEXT),
    _clouds("ply", "*.ply", (mutations.raw, mutations.raw, mutations.whole)),
    _clouds("npy", "*.npy", (mutations.raw, mutations.raw, mutations.whole)),
    _clouds("bin", "*.bin", (mutations.raw, mutations.whole)),
    _clouds("las", "*.las", (*(mutations.number("las"),) * 4, mutations.raw, mutations.raw, mutations.whole)),
    _capture("velodyne", "a.pcap", _PCAP),
    _capture("ouster", "a.pcap", _PCAP),
    _capture("ouster", "a.json", _TREE),
    Kind(
        "tum",
        "poses",
        ("estimate.tum",),
        _TEXT,
        (
            ("eval", "{in}/estimate.tum", "{in}/reference.tum"),
            ("eval", "{in}/reference.tum", "{in}/estimate.tum", "--json"),
        ),
    ),
    Kind(
        "kitti poses",
        "poses",
        ("estimate.txt", "times.txt"),
        _TEXT,
        (
            ("eval", "{in}/estimate.txt", "{in}/reference.txt"),
            ("eval", "{in}/reference.txt", "{in}/estimate.txt", "--json"),
        ),
    ),
    Kind(
        "g2o",
        "graph",
        ("*.g2o",),
        _TEXT,
        (
            ("optimize-graph", "{in}/in.g2o", "{out}/r.g2o"),
            ("optimize-graph", "{in}/plane.g2o", "{out}/r.g2o", "--json"),
        ),
    ),
    Kind(
        "settings",
        "settings",
        ("my.yaml",),
        _TREE,
        (("run", "{in}/nowhere", "--recipe", "{in}/my.yaml", "--out", "{out}/r"),),
        _NOWHERE,
    ),
    Kind(
        "foreign",
        "foreign",
        ("*.yaml",),
        _TREE,
        tuple(
            ("run", "{in}/nowhere", "--params-from", f"{{in}}/{name}.yaml", "--out", "{out}/r")
            for name in ("lio_sam", "fast_lio")
        ),
        _NOWHERE,
    ),
    Kind(
        "spec",
        "spec",
        ("spec.yaml",),
        _TREE,
        (("ablate", "{in}/spec.yaml", "--out", "{out}/taken"),),
        r"taken: is a file",
    ),
    Kind(
        "map", "run", ("run/map.pcd", "run/keyframes/*"), _NPZ, (("map", "{in}/run", "--out", "{out}/r.pcd"),)
    ),
    Kind(
        "report",
        "run",
        ("run/*.npz", "run/*.json", "run/*.tum", "run/config.yaml"),
        _ANY,
        (("report", "{in}/run", "--out", "{out}/r.html"),),
    ),
)
"""All kinds of input."""
