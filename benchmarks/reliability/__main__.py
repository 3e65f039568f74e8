"""python -m benchmarks.reliability PART: faults, load, isolation, fuzz, contract, elsewhere, or report.

Each part writes its figures as JSON into out/reliability/ (or --out); `report` turns what is there into
docs/reliability.md. Nothing but 127.0.0.1 and unix sockets is used.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection
from pathlib import Path

from benchmarks.reliability.figures import OUT


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability", description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the figures")
    parts = parser.add_subparsers(dest="part", required=True)
    part = parts.add_parser("faults", help="kill, stop, race; count what was lost")
    part.add_argument("--kills", type=int, default=50, help="faults of each kind")
    part.add_argument("--rows", default="", help="only these, separated by commas")
    part.add_argument("--resume", action="store_true", help="skip rows whose figures are there")
    part = parts.add_parser("fuzz", help="inputs that no honest caller sends")
    part.add_argument("--inputs", type=int, default=1_100_000, help="of all readers together")
    part.add_argument("--seed", type=int, default=0)
    part.add_argument("--workers", type=int, default=2, help="processes")
    part.add_argument("--only", default="", help="only these readers, separated by commas")
    part = parts.add_parser("load", help="many robots for a long time")
    part.add_argument("--robots", type=int, default=32)
    part.add_argument("--seconds", type=float, default=600.0)
    part.add_argument(
        "--rate", type=float, default=0.0, help="steps a second of a robot; 0: as fast as it goes"
    )
    part.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the server"
    )
    part = parts.add_parser("isolation", help="a robot beside each attack")
    part.add_argument("--only", default="", help="only these attacks, separated by commas")
    part.add_argument("--resume", action="store_true", help="skip attacks whose figures are there")
    part = parts.add_parser("contract", help="schemathesis")
    part.add_argument("--examples", type=int, default=100, help="cases of each operation")
    part.add_argument("--seed", type=int, default=1)
    part = parts.add_parser("elsewhere", help="other measurements of benchmarks/ that the page shows")
    part.add_argument("--only", default="", help="only these modules, separated by commas")
    part.add_argument("--resume", action="store_true", help="skip those whose figures are there")
    part = parts.add_parser("report", help="docs/reliability.md from the figures")
    part.add_argument("--page", type=Path, default=None)
    args = parser.parse_args()
    command = "python -m benchmarks.reliability " + " ".join(sys.argv[1:])
    if args.part == "faults":
        from benchmarks.reliability.faults import rows

        return rows.run(args.out, args.kills, some(args.rows, rows.ROWS), args.resume, command)
    if args.part == "fuzz":
        from benchmarks.reliability.fuzz import shards

        names = some(args.only, shards.TARGETS)
        return min(1, shards.run(args.out, args.inputs, args.seed, args.workers, names, command))
    if args.part == "load":
        from benchmarks.reliability import load

        return load.run(args.out, args.robots, args.seconds, args.rate, args.set, command)
    if args.part == "isolation":
        from benchmarks import attacks
        from benchmarks.reliability import isolation

        names = some(args.only, attacks.ATTACKS)
        return min(1, isolation.run(args.out, names, args.resume, command))
    if args.part == "contract":
        from benchmarks.reliability.contract import run

        return run.run(args.out, args.examples, args.seed, command)
    if args.part == "elsewhere":
        from benchmarks.reliability import elsewhere

        return min(1, elsewhere.run(args.out, some(args.only, elsewhere.MODULES), args.resume))
    from benchmarks.reliability import report

    return report.run(args.out, args.page or report.PAGE)


def some(asked: str, known: Collection[str]) -> list[str]:
    """What is asked for, separated by commas; all that is known where nothing is. Ends the program where
    something is asked for that is not known.
    """
    names = asked.split(",") if asked else list(known)
    for name in names:
        if name not in known:
            sys.exit(f"there is no {name!r}; there are {', '.join(known)}")
    return names


if __name__ == "__main__":
    sys.exit(main())
