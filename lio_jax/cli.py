"""The command line ``lio-jax``.

Exit status: 0 done; 1 the job failed; 2 wrong usage. Errors are one sentence; ``--debug`` adds the traceback.
"""

import os
import re
import sys
import traceback
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from lio_jax.commands.runtime import ended_like_ctrl_c, usage_in_a_sentence
from lio_jax.commands.sim_options import ErrorOptions, Format, MotionOptions, SensorOptions
from lio_jax.core.errors import LioJaxError, UsageError, one_line
from lio_jax.tuning.objective_names import EXAMPLE, LISTED

Assignments = Annotated[
    tuple[str, ...],
    arg(name="set", metavar="PATH=VALUE ...", help="Replace settings, e.g. params.map.voxel_size=0.5."),
]
Data = Positional[Annotated[Path, arg(metavar="DATA")]]
Recipe = Annotated[str | None, arg(metavar="NAME|FILE.yaml|FILE.py:CLASS")]
ParamsFrom = Annotated[
    Path | None,
    arg(
        metavar="FILE.yaml",
        help="LIO-SAM's or FAST-LIO2's own parameter file: beats the recipe's values, yields to those of a "
        "--recipe file and of --set.",
    ),
]
Overwrite = Annotated[bool, tyro.conf.FlagCreatePairsOff]

app = tyro.extras.SubcommandApp()


@app.command(name="demo")
def demo(out: Annotated[Path, arg(metavar="DIR")] = Path("out/demo"), overwrite: Overwrite = False) -> None:
    """Simulate a drive through a city, run on it and compare with the truth.

    Args:
        out: Folder for the results.
        overwrite: Replace the results of an earlier run in that folder.
    """
    from lio_jax.commands.runtime import prepare_jax
    from lio_jax.commands.sim import demo as command

    prepare_jax()
    command(out, overwrite)


@app.command(name="sim")
def sim(
    world: Positional[Annotated[str, arg(metavar="WORLD")]],
    out: Annotated[Path, arg(metavar="PATH")],
    sensor: Annotated[str, arg(metavar="S")] = "vlp16",
    duration: Annotated[float | None, arg(metavar="SEC")] = None,
    seed: Annotated[int, arg(metavar="K")] = 0,
    format: Annotated[Format | None, arg(name="format")] = None,
    overwrite: Overwrite = False,
    *,
    motion: tyro.conf.OmitArgPrefixes[MotionOptions],
    sensors: tyro.conf.OmitArgPrefixes[SensorOptions],
    errors: tyro.conf.OmitArgPrefixes[ErrorOptions],
) -> None:
    """Simulate a recording whose truth is known: native folder or ROS bag.

    Args:
        world: World to move through; an unknown name lists those that exist.
        out: Output: *.bag (ROS 1), *.mcap or *.db3 (ROS 2), else a native folder. The truth of a bag goes to
            NAME.truth.tum and NAME.truth.npz in the same folder.
        sensor: LiDAR; an unknown name lists those that exist.
        duration: Length; None means 60 s, or all of --trajectory.
        seed: Seed of world, motion and noise: the same seed gives the same bytes.
        format: Format, if PATH's ending does not state it, for example a ROS 2 bag folder.
        overwrite: Replace an existing recording.
    """
    from lio_jax.commands.runtime import prepare_jax
    from lio_jax.commands.sim import sim as command

    prepare_jax()
    command(world, sensor, duration, seed, out, format, overwrite, motion, sensors, errors)


@app.command(name="inspect")
def inspect(
    data: Data,
    set_: Assignments = (),
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    write_config: Annotated[Path | None, arg(metavar="FILE")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Show a recording's contents, its faults, and the settings that fit it.

    Args:
        data: Recording: KITTI folder, ROS bag, .pcap, folder of clouds, native folder, or evalio:NAME.
        json: Print one JSON object instead of a table.
        write_config: Write the settings that fit, for --recipe of lio-jax run.
        overwrite: Replace an existing file.
    """
    from lio_jax.commands.runtime import prepare_jax
    from lio_jax.commands.show import inspect as command

    prepare_jax()
    command(data, set_, json, write_config, overwrite)


@app.command(name="run")
def run(
    data: Data,
    out: Annotated[Path, arg(metavar="DIR")],
    recipe: Recipe = None,
    set_: Assignments = (),
    params_from: ParamsFrom = None,
    start: Annotated[int, arg(metavar="N")] = 0,
    scans: Annotated[int | None, arg(metavar="N")] = None,
    gt: Annotated[Path | None, arg(metavar="FILE")] = None,
    overwrite: Overwrite = False,
    live: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Estimate trajectory and map of a recording.

    Args:
        data: Recording: KITTI odometry sequence or raw drive, ROS bag, .pcap, folder of clouds, native
            folder, or evalio:NAME.
        out: Folder for the results.
        recipe: Recipe, settings file, or class of your own recipe; a run's config.yaml repeats that run.
            None means default, or with --params-from the recipe that follows that system.
        start: First scan.
        scans: Number of scans; None means all.
        gt: Ground truth of T_world_imu (TUM, run folder or recording); None means the recording's own.
        overwrite: Replace the results of an earlier run in that folder.
        live: Show the run in a browser of this computer while it goes on.
        resume: Go on with a run that was killed or interrupted; start it where there is none, and do nothing
            where it is finished.
    """
    from lio_jax.commands.run import run as command
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    command(data, recipe, set_, params_from, out, start, scans, gt, overwrite, live, resume)


@app.command(name="eval")
def evaluate(
    estimate: Positional[Annotated[Path, arg(metavar="ESTIMATE")]],
    reference: Positional[Annotated[Path | None, arg(metavar="REFERENCE")]] = None,
    gps: Annotated[Path | None, arg(metavar="DATA")] = None,
    set_: Assignments = (),
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Compare a trajectory with a reference (ATE, RPE, KITTI segment errors), or with GPS fixes.

    Args:
        estimate: Run folder, TUM file or KITTI poses.
        reference: Run folder, TUM file or KITTI poses, or a recording that holds ground truth.
        gps: Recording whose GPS fixes are compared with instead, by the settings of the run.
        json: Print one JSON object instead of a table.
    """
    from lio_jax.commands.show import evaluate as command

    command(estimate, reference, gps, set_, json)


@app.command(name="report")
def report(
    folders: Positional[Annotated[tuple[Path, ...], arg(metavar="DIR [DIR ...]")]],
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
) -> None:
    """Draw a run's report again, or compare several runs on one page.

    Args:
        folders: Folders that lio-jax run wrote.
        out: HTML file; None means report.html in the one folder.
    """
    from lio_jax.commands.show import report as command

    command(folders, out)


@app.command(name="view")
def view(
    folder: Positional[Annotated[Path, arg(metavar="DIR")]],
    web: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Open a run's recording: clouds, map, trajectory and the estimator's state, over time.

    Args:
        folder: Folder that lio-jax run wrote, or an .rrd.
        web: Serve it to browsers of this computer instead of opening a window.
    """
    from lio_jax.commands.show import view as command

    command(folder, web)


@app.command(name="export")
def export(
    data: Data,
    to: Literal["bag", "kitti", "native"],
    out: Annotated[Path, arg(metavar="PATH")],
    set_: Assignments = (),
    layout: Annotated[str, arg(metavar="MAKE")] = "velodyne",
    start: Annotated[int, arg(metavar="N")] = 0,
    scans: Annotated[int | None, arg(metavar="N")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a recording in another format: ROS bag, KITTI odometry sequence or native folder.

    Args:
        data: Recording: KITTI folder, ROS bag, .pcap, folder of clouds, native folder, or evalio:NAME.
        to: Output format.
        out: Output: *.bag (ROS 1), *.mcap or *.db3 (ROS 2); else a folder.
        layout: Make of the LiDAR whose messages a bag gets: velodyne, ouster or livox.
        start: First scan. Inertial samples, GPS fixes and truth are written from a second before it.
        scans: How many scans; None means all. Samples, fixes and truth end a second after the last one.
        overwrite: Replace the recording that is there.
    """
    from lio_jax.commands.export import export as command

    command(data, to, out, set_, layout, start, scans, overwrite)


@app.command(name="map")
def map_(
    folder: Positional[Annotated[Path, arg(metavar="DIR")]],
    out: Annotated[Path, arg(metavar="FILE")],
    voxel: Annotated[float, arg(metavar="SIZE")] = 0.2,
    part: Literal["whole", "corner", "surface"] = "whole",
    overwrite: Overwrite = False,
) -> None:
    """Write the map of a run at a chosen resolution, as PCD or PLY.

    Args:
        folder: Folder that lio-jax run wrote.
        out: Output: *.pcd or *.ply.
        voxel: Edge of the cubes of which each gives one point, m.
        part: All points, or only corners or only surfaces, where the recipe separates them.
        overwrite: Replace an existing file.
    """
    from lio_jax.commands.map import make_map

    make_map(folder, out, voxel, part, overwrite)


@app.command(name="tune")
def tune(
    data: Positional[Annotated[tuple[Path, ...], arg(metavar="DATA [DATA ...]")]],
    params: Annotated[str, arg(metavar="GLOB,...")],
    out: Annotated[Path, arg(metavar="DIR")],
    objective: Annotated[
        str | None,
        arg(
            metavar="NAME",
            help=f"One of {LISTED}, or a sum such as {EXAMPLE}; marginal needs lio_sam, or "
            "parameters of loops and GPS. None means noise, or ate for loops and GPS.",
        ),
    ] = None,
    recipe: Recipe = None,
    set_: Assignments = (),
    params_from: ParamsFrom = None,
    validate: Annotated[tuple[Path, ...], arg(metavar="DATA ...")] = (),
    gt: Annotated[Path | None, arg(metavar="FILE")] = None,
    optimizer: Literal["auto", "scoring", "lbfgsb", "stationary", "adam"] = "auto",
    iterations: Annotated[int, arg(metavar="N")] = 40,
    patience: Annotated[int, arg(metavar="N")] = 10,
    start: Annotated[int, arg(metavar="N")] = 0,
    scans: Annotated[int | None, arg(metavar="N")] = None,
    segment: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="K")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Tune parameters by gradient; the objective noise needs no ground truth.

    Args:
        data: Recordings to tune on.
        params: Parameters, for example imu.gyro_noise,imu.accel_noise, extrinsics.*, or loop.*,gps.* with the
            back end.
        out: Folder for tuned.yaml, history.json and tuning.png; an earlier tuning there is continued.
        recipe: Recipe, settings file or class of your own recipe to start from; None as for run.
        validate: Recordings that decide which iterate is taken and when to stop.
        gt: Ground truth of T_world_imu; None means the recordings' own.
        optimizer: auto takes scoring for likelihoods, stationary for extrinsics and corrections of points,
            lbfgsb for the others; adam steps on segments.
        iterations: Largest number of evaluations.
        patience: Number of evaluations without a better one after which the tuning ends.
        start: First scan.
        scans: Number of scans of each recording; None means all.
        segment: Cut recordings into segments of this many scans; each starts on its own.
        seed: Seed of the segments that adam draws.
        overwrite: Start again if the folder holds an earlier tuning.
    """
    from lio_jax.commands.runtime import prepare_jax
    from lio_jax.commands.tune import TuneOptions
    from lio_jax.commands.tune import tune as command

    prepare_jax()
    options = TuneOptions(
        recipe,
        set_,
        params_from,
        params,
        objective,
        optimizer,
        iterations,
        patience,
        start,
        scans,
        segment,
        seed,
        overwrite,
    )
    command(data, validate, gt, out, options)


@app.command(name="train")
def train(
    data: Positional[Annotated[tuple[Path, ...], arg(metavar="DATA")]],
    params: Annotated[str, arg(metavar="GLOB,...")],
    out: Annotated[Path, arg(metavar="DIR")],
    objective: Annotated[
        str | None, arg(metavar="NAME", help="As for tune. None means noise, or ate for loops and GPS.")
    ] = None,
    recipe: Recipe = None,
    set_: Assignments = (),
    validate: Annotated[tuple[Path, ...], arg(metavar="DATA ...")] = (),
    gt: Annotated[Path | None, arg(metavar="FILE")] = None,
    segment: Annotated[int, arg(metavar="N")] = 50,
    batch: Annotated[int, arg(metavar="N")] = 4,
    epochs: Annotated[int, arg(metavar="N")] = 20,
    rate: Annotated[float, arg(metavar="X")] = 0.01,
    patience: Annotated[int, arg(metavar="N")] = 5,
    seed: Annotated[int, arg(metavar="K")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Train learned parts, such as a network in your own recipe, by steps on pieces of recordings.

    Args:
        data: Recordings to learn from.
        params: Parameters, for example learned.weights; many numbers cost no more than a few.
        out: Folder for trained.yaml, training.npz and training.png; an earlier training there is continued.
        recipe: Recipe, settings file or class of your own recipe to start from; None as for run.
        validate: Recordings that decide which epoch is taken and when to stop.
        gt: Ground truth of T_world_imu; None means the recordings' own.
        segment: Number of scans of a piece; each piece starts on its own.
        batch: Number of pieces in one step.
        epochs: Number of times that all pieces are used.
        rate: First length of a step; it falls to zero until the last epoch.
        patience: Number of epochs without a lower loss on --validate after which the training ends.
        seed: Seed of the order of the pieces.
        overwrite: Start again if the folder holds an earlier training.
    """
    from lio_jax.commands.runtime import prepare_jax
    from lio_jax.commands.train import train as command
    from lio_jax.tuning.train import Schedule

    prepare_jax()
    schedule = Schedule(batch, epochs, rate, patience, seed)
    command(data, params, out, objective, recipe, set_, validate, gt, segment, schedule, overwrite)


@app.command(name="ablate")
def ablate(
    spec: Positional[Annotated[Path, arg(metavar="SPEC.yaml")]],
    out: Annotated[Path, arg(metavar="DIR")],
    scheduler: Annotated[str, arg(metavar="ADDRESS")] = "",
    report: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    retry_failed: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Compare settings over recordings and seeds; the same command continues an interrupted one.

    Args:
        spec: Recordings, settings to compare and metrics; configs/ablations/ has examples.
        out: Folder for the runs, the table and the report; finished runs in it are not repeated.
        scheduler: Running dask scheduler; without it, workers are started on this machine.
        report: Write report.html: ranking, pictures, failures.
        retry_failed: Try failed runs again.
    """
    from lio_jax.commands.ablate import ablate as command

    command(spec, out, scheduler, report, retry_failed)


@app.command(name="optimize-graph")
def optimize_graph(
    graph: Positional[Annotated[Path, arg(metavar="IN.g2o")]],
    out: Positional[Annotated[Path, arg(metavar="OUT.g2o")]],
    robust: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Find the poses that agree best with all edges of a pose graph.

    Args:
        graph: Pose graph, in 3D or in the plane; it needs edges, and may have vertices and FIX lines.
        out: Output: the graph with the poses of the solution.
        robust: Distrust loops that contradict the rest.
        json: Print one JSON object instead of a table.
    """
    from lio_jax.commands.optimize_graph import optimize_graph as command
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    command(graph, out, robust, json)


@app.command(name="fuse")
def fuse(
    odometry: Positional[Annotated[Path, arg(metavar="ODOMETRY")]],
    imu: Annotated[Path, arg(metavar="FILE")],
    out: Annotated[Path, arg(metavar="DIR")],
    gps: Annotated[Path | None, arg(metavar="FILE")] = None,
    truth: Annotated[Path | None, arg(metavar="FILE")] = None,
    tune: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    set_: Assignments = (),
    overwrite: Overwrite = False,
) -> None:
    """Fuse the poses of any odometry with inertial samples and GPS fixes, over the whole recording.

    Args:
        odometry: Poses of the odometry's sensor: TUM file or run folder.
        imu: Inertial samples: table (CSV), recording, or native imu.npz; in the odometry's clock.
        out: Folder for the results. trajectory.tum has the frames of the odometry: its sensor in its world.
        gps: Fixes: table of time and local metres or degrees, or a recording.
        truth: True poses of the odometry's sensor, to compare with.
        tune: Find the noise of odometry, samples and fixes by the likelihood of the recording.
        overwrite: Replace the results of an earlier run in that folder.
    """
    from lio_jax.commands.fuse import fuse as command
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    command(odometry, imu, gps, truth, tune, set_, out, overwrite)


@app.command(name="calibrate-imu")
def calibrate_imu(
    data: Positional[Annotated[Path, arg(metavar="STATIC_DATA")]],
    out: Annotated[Path, arg(metavar="FILE.yaml")],
    plot: Annotated[Path | None, arg(metavar="FILE.png")] = None,
    skip: Annotated[float, arg(metavar="SEC")] = 0.0,
) -> None:
    """Find an IMU's noise densities from a recording at rest, by its Allan deviation.

    Args:
        data: Recording at rest, or the imu.npz of a native folder.
        out: Settings file for --recipe.
        plot: Picture of the Allan deviation.
        skip: Time to leave out at the start, s.
    """
    from lio_jax.commands.calibrate_imu import calibrate_imu as command

    command(data, out, plot, skip)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    try:
        if words[:1] == ["--version"]:
            print(f"lio-jax {version('lio-jax')}")
            return 0
        words = _gathered([word for word in words if word != "--debug"])
        with usage_in_a_sentence(words, app), ended_like_ctrl_c():
            app.cli(args=words, prog="lio-jax", description=_DESCRIPTION)
        sys.stdout.flush()
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else 2
    except BrokenPipeError:
        # the reader of the output has closed the pipe; nothing may be left to be flushed to it at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (KeyboardInterrupt, Exception) as error:
        if debug:
            traceback.print_exc()
        else:
            print(f"lio-jax: {_sentence(error)}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    return 0


_DESCRIPTION = (
    "Differentiable LiDAR-inertial odometry. --version prints the version. Add --debug to any command for "
    "the traceback of an error."
)


def _sentence(error: BaseException) -> str:
    if isinstance(error, LioJaxError):
        return one_line(str(error))
    if isinstance(error, KeyboardInterrupt):
        return "interrupted before the job was done."
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}; check the path, its permissions and the free space."
    reason = " ".join(str(error).split()) or "no reason given"
    return f"unexpected {type(error).__name__}: {reason}; run again with --debug and report it."


def _gathered(words: list[str]) -> list[str]:
    """Move all ``--set`` assignments behind one ``--set`` at the end, so that the option may be repeated.

    A word after ``--set`` is an assignment, and so is each further word of the form NAME=VALUE.

    Raises:
        UsageError: nothing follows a ``--set``.
    """
    rest: list[str] = []
    assignments: list[str] = []
    first = further = False
    for word in words:
        if first and word.startswith("--"):
            break
        if word == "--set" or word.startswith("--set="):
            _, joined, value = word.partition("=")
            assignments += [value] if joined else []
            first, further = not joined, bool(joined)
        elif first or (further and re.match(r"[\w.]+=", word)):
            assignments.append(word)
            first, further = False, True
        else:
            further = False
            rest.append(word)
    if first:
        raise UsageError("--set: nothing follows it; write for example --set params.map.voxel_size=0.5.")
    return rest + (["--set", *assignments] if assignments else [])


if __name__ == "__main__":
    sys.exit(main())
