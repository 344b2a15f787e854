"""The command line ``lio-jax``.

Exit status: 0 done; 1 the job failed; 2 wrong usage. Errors are one sentence; ``--debug`` adds the traceback.
"""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from lio_jax.core.errors import LioJaxError, UsageError

Assignments = Annotated[
    tuple[str, ...],
    arg(name="set", metavar="PATH=VALUE ...", help="Replace settings, such as params.map.voxel_size=0.5."),
]
Overwrite = Annotated[bool, tyro.conf.FlagCreatePairsOff]

app = tyro.extras.SubcommandApp()


@app.command(name="demo")
def demo(out: Path = Path("out/demo"), overwrite: Overwrite = False) -> None:
    """Simulate a street, run on it and compare with the truth.

    Args:
        out: Folder for the results.
        overwrite: Replace the results of an earlier run in that folder.
    """
    from lio_jax.commands.demo import demo as command
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    command(out, overwrite)


@app.command(name="inspect")
def inspect(
    data: Positional[Path],
    set_: Assignments = (),
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Say what is in a recording, what is wrong with it and which settings fit.

    Args:
        data: Recording: KITTI folder, ROS bag or native folder.
        json: Print one JSON object instead of a table.
    """
    from lio_jax.commands.inspect import inspect as command

    command(data, set_, json)


@app.command(name="run")
def run(
    data: Positional[Path],
    out: Path,
    recipe: str = "default",
    set_: Assignments = (),
    start: int = 0,
    scans: int | None = None,
    gt: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Estimate trajectory and map of a recording.

    Args:
        data: Recording: KITTI odometry sequence or raw drive, ROS 1 or ROS 2 bag, native folder.
        out: Folder for the results.
        recipe: Recipe name or settings file (*.yaml).
        start: First scan.
        scans: Number of scans; default: all.
        gt: Ground truth (TUM, T_world_imu), where the recording holds none.
        overwrite: Replace the results of an earlier run in that folder.
    """
    from lio_jax.commands.run import run as command
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    command(data, recipe, set_, out, start, scans, gt, overwrite)


@app.command(name="eval")
def evaluate(
    estimate: Positional[Path],
    reference: Positional[Path],
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> None:
    """Compare a trajectory with a reference: ATE, RPE, KITTI segment errors.

    Args:
        estimate: Run folder, TUM file or KITTI poses.
        reference: The same, or a recording that holds ground truth.
        json: Print one JSON object instead of a table.
    """
    from lio_jax.commands.evaluate import evaluate as command

    command(estimate, reference, json)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    words = _gathered([word for word in words if word != "--debug"])
    try:
        app.cli(args=words, prog="lio-jax", description="Differentiable LiDAR-inertial odometry.")
    except LioJaxError as error:
        if debug:
            raise
        print(f"lio-jax: {error}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except KeyboardInterrupt:
        if debug:
            raise
        print("lio-jax: interrupted before anything was computed.", file=sys.stderr)
        return 1
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else 2
    except Exception as error:
        if debug:
            raise
        reason = " ".join(str(error).split()) or "no reason given"
        print(
            f"lio-jax: unexpected {type(error).__name__}: {reason}; run again with --debug and report it.",
            file=sys.stderr,
        )
        return 1
    return 0


def _gathered(words: list[str]) -> list[str]:
    """Move all ``--set`` assignments behind one ``--set`` at the end, so that it may be repeated anywhere."""
    rest: list[str] = []
    assignments: list[str] = []
    taking = False
    for word in words:
        if word == "--set":
            taking = True
        elif taking and not word.startswith("--") and "=" in word:
            assignments.append(word)
        else:
            taking = False
            rest.append(word)
    return rest + (["--set", *assignments] if assignments else [])


if __name__ == "__main__":
    sys.exit(main())
