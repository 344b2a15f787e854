"""The KITTI odometry table: translation in % and rotation in deg/100 m of each sequence, from one command.

    python experiments/reproduce_kitti.py KITTI --out out/kitti [--recipes default loam]
        [--sequences 00 04] [--scheduler ADDRESS] [--json]

KITTI is the folder that holds sequences/ and poses/. Missing sequences are left out and reported. Finished
runs are not repeated: a killed command continues where it was. Errors are those of the benchmark, over
segments of 100 to 800 m; a sequence shorter than 100 m has none.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import yaml

from lio_jax.ablation.ranking import VariantComparison, compare
from lio_jax.ablation.spec import Spec, load_spec
from lio_jax.ablation.store import Store
from lio_jax.ablation.tasks import tasks_of
from lio_jax.commands.ablate import ablate
from lio_jax.core.errors import LioJaxError, UsageError

PERCENT, PER_METRE, MILLISECONDS = (
    "kitti.translation_percent",
    "kitti.rotation_deg_per_m",
    "scan_ms.total.median",
)
PUBLISHED = [f"{number:02d}" for number in range(11)]
"""The sequences whose truth is published."""


def main() -> int:
    """Run the sequences that are not done yet, and print the table."""
    options = _options()
    there = [name for name in options.sequences if (options.kitti / "sequences" / name / "velodyne").is_dir()]
    if missing := [name for name in options.sequences if name not in there]:
        print(f"note: not in {options.kitti / 'sequences'}: {' '.join(missing)}", file=sys.stderr)
    try:
        if not there:
            raise UsageError(
                f"{options.kitti}: holds no sequences/NN/velodyne; give KITTI odometry's folder."
            )
        options.out.mkdir(parents=True, exist_ok=True)
        spec_path = options.out / "kitti.yaml"
        spec_path.write_text(_specification(options, there))
        ablate(spec_path, options.out / "runs", options.scheduler, report=True, retry_failed=False)
    except LioJaxError as error:
        print(f"reproduce_kitti: {error}", file=sys.stderr)
        if isinstance(error, UsageError):
            return 2
    spec = load_spec(spec_path)
    comparison = compare(spec, tasks_of(spec), Store(options.out / "runs"))
    table = {variant.name: _rows(comparison, variant.name, there) for variant in spec.variants}
    _print(spec, table)
    if options.json:
        print(json.dumps(table))
    return 1 if comparison.failures else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kitti", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recipes", nargs="+", default=["default"], metavar="NAME|FILE.yaml")
    parser.add_argument("--sequences", nargs="+", default=PUBLISHED, metavar="NN")
    parser.add_argument("--scheduler", default="", help="running dask scheduler")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def _specification(options: argparse.Namespace, there: list[str]) -> str:
    folder = (options.kitti / "sequences").resolve()
    tree = {
        "name": "KITTI odometry",
        "sequences": [{"path": str(folder / name)} for name in there],
        "list": [{"name": Path(recipe).stem, "recipe": _resolved(recipe)} for recipe in options.recipes],
        "metrics": [PERCENT, PER_METRE, "ate.rmse", "failed_scans", MILLISECONDS],
    }
    return yaml.safe_dump(tree, sort_keys=False)


def _resolved(recipe: str) -> str:
    return str(Path(recipe).resolve()) if recipe.endswith((".yaml", ".yml")) else recipe


def _rows(comparison: VariantComparison, variant: str, there: list[str]) -> dict[str, dict[str, Any]]:
    """Return translation %, rotation deg/100 m and ms of each sequence; None without a value."""
    found = {}
    for name in there:
        values = {
            metric: comparison.values[metric].get(variant, {}).get((name, None))
            for metric in (PERCENT, PER_METRE, MILLISECONDS)
        }
        turned = values[PER_METRE]
        found[name] = {
            "translation_percent": values[PERCENT],
            "rotation_deg_per_100m": None if turned is None else 100 * turned,
            "scan_ms": values[MILLISECONDS],
        }
    return found


def _print(spec: Spec, table: dict[str, dict[str, dict[str, Any]]]) -> None:
    for variant, rows in table.items():
        print(f"\n{variant}\n{'sequence':>10}{'trans. %':>10}{'deg/100 m':>11}{'ms/scan':>9}")
        for name, row in rows.items():
            print(
                f"{name:>10}{_cell(row['translation_percent']):>10}"
                f"{_cell(row['rotation_deg_per_100m']):>11}{_cell(row['scan_ms'], 1):>9}"
            )
        means = [
            [row[key] for row in rows.values() if row[key] is not None]
            for key in ("translation_percent", "rotation_deg_per_100m", "scan_ms")
        ]
        percent, turned, spent = (sum(values) / len(values) if values else math.nan for values in means)
        print(f"{'mean':>10}{_cell(percent):>10}{_cell(turned):>11}{_cell(spent, 1):>9}")


def _cell(value: float | None, digits: int = 3) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


if __name__ == "__main__":
    sys.exit(main())
