"""``python -m experiments.fuzz``: run a campaign and print its table.

The exit status is 1 if anything failed, and 2 if the campaign cannot run.
"""

import argparse
import sys
from pathlib import Path

from experiments.fuzz.campaign import run_campaign
from experiments.fuzz.kinds import KINDS
from lio_jax.core.errors import LioJaxError


def main() -> int:
    """Read the options, run the campaign, print the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="number of damaged inputs")
    parser.add_argument("--seed", type=int, default=0, help="of the damage")
    parser.add_argument("--kinds", nargs="*", default=[], choices=[kind.name for kind in KINDS])
    parser.add_argument("--work", type=Path, default=Path("out/fuzz"), help="seeds, and failures in kept/")
    options = parser.parse_args()
    try:
        campaign = run_campaign(options.work, options.inputs, options.seed, tuple(options.kinds), show=True)
    except LioJaxError as error:
        print(f"fuzz: {error}", file=sys.stderr)
        return 2
    print(campaign.table())
    return 1 if campaign.failures else 0


if __name__ == "__main__":
    sys.exit(main())
