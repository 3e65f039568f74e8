"""python -m benchmarks.reliability PART: faults, load, isolation, fuzz, contract, elsewhere, or report.

Each part writes its figures as JSON into out/reliability/ (or --out); `report` turns what is there into
docs/reliability.md. Nothing but 127.0.0.1 and unix sockets is used.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.reliability.figures import OUT


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability", description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the figures")
    parts = parser.add_subparsers(dest="part", required=True)
    faults = parts.add_parser("faults", help="kill, stop, race; count what was lost")
    faults.add_argument("--kills", type=int, default=50, help="faults of each kind")
    faults.add_argument("--rows", default="", help="only these, separated by commas")
    faults.add_argument("--resume", action="store_true", help="skip rows whose figures are there")
    fuzz = parts.add_parser("fuzz", help="inputs that no honest caller sends")
    fuzz.add_argument("--inputs", type=int, default=1_100_000, help="of all readers together")
    fuzz.add_argument("--seed", type=int, default=0)
    fuzz.add_argument("--workers", type=int, default=2, help="processes")
    fuzz.add_argument("--only", default="", help="only these readers, separated by commas")
    load = parts.add_parser("load", help="many robots for a long time")
    load.add_argument("--robots", type=int, default=32)
    load.add_argument("--seconds", type=float, default=600.0)
    load.add_argument(
        "--rate", type=float, default=0.0, help="steps a second of a robot; 0: as fast as it goes"
    )
    load.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the server"
    )
    isolation = parts.add_parser("isolation", help="a robot beside each attack")
    isolation.add_argument("--only", default="", help="only these attacks, separated by commas")
    isolation.add_argument("--resume", action="store_true", help="skip attacks whose figures are there")
    contract = parts.add_parser("contract", help="schemathesis")
    contract.add_argument("--examples", type=int, default=100, help="cases of each operation")
    contract.add_argument("--seed", type=int, default=1)
    elsewhere = parts.add_parser("elsewhere", help="other measurements of benchmarks/ that the page shows")
    elsewhere.add_argument("--only", default="", help="only these modules, separated by commas")
    elsewhere.add_argument("--resume", action="store_true", help="skip those whose figures are there")
    report = parts.add_parser("report", help="docs/reliability.md from the figures")
    report.add_argument("--page", type=Path, default=None)
    args = parser.parse_args()
    command = "python -m benchmarks.reliability " + " ".join(sys.argv[1:])
    if args.part == "faults":
        from benchmarks.reliability.faults import rows as part

        names = args.rows.split(",") if args.rows else list(part.ROWS)
        return part.run(args.out, args.kills, names, args.resume, command)
    if args.part == "fuzz":
        from benchmarks.reliability.fuzz import shards as part

        names = args.only.split(",") if args.only else list(part.TARGETS)
        return min(1, part.run(args.out, args.inputs, args.seed, args.workers, names, command))
    if args.part == "load":
        from benchmarks.reliability import load as part

        return part.run(args.out, args.robots, args.seconds, args.rate, args.set, command)
    if args.part == "isolation":
        from benchmarks.reliability import isolation as part

        names = args.only.split(",") if args.only else []
        return min(1, part.run(args.out, names, args.resume, command))
    if args.part == "contract":
        from benchmarks.reliability.contract import run as part

        return part.run(args.out, args.examples, args.seed, command)
    if args.part == "elsewhere":
        from benchmarks.reliability import elsewhere as part

        names = args.only.split(",") if args.only else list(part.MODULES)
        return min(1, part.run(args.out, names, args.resume))
    from benchmarks.reliability import report as part

    return part.run(args.out, args.page or part.PAGE)


if __name__ == "__main__":
    sys.exit(main())
