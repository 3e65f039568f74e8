"""All runs of an experiment, spread over processes or job workers.

Runs are kept in a folder as they finish; a campaign that was interrupted goes on from what the folder holds.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from evaluation import jobs
from evaluation.experiment import Experiment
from evaluation.runs import Record, run
from specshield.errors import InputError
from specshield.policy.tensors import replace_file
from specshield.sim.campaign import each_done

ABOUT, RUNS = "experiment.json", "runs.jsonl"
Missing = Mapping[int, Sequence[str]]  # {run: methods}
T = TypeVar("T")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def evaluate(
    experiment: Experiment,
    runs: int,
    methods: Sequence[str],
    folder: Path | None = None,
    processes: int = 1,
    redis_url: str | None = None,
    on_progress: Callable[[int], None] = lambda _: None,
) -> list[Record]:
    """The records of `runs` runs by each method, ordered by run and then by method.

    methods: one that is named twice counts once. folder: finished runs are kept there, and those that it
    holds already are not made again. processes: with 1, the runs are made in this process. redis_url: a Redis
    from which job workers take the runs instead. on_progress: called with the number of finished runs. Raises
    InputError where `folder` holds another experiment, or records made from another map, policy or model.
    """
    methods = list(dict.fromkeys(methods))
    done = {} if folder is None else _open(folder, experiment)
    missing = {i: left for i in range(runs) if (left := [name for name in methods if (i, name) not in done])}
    on_progress(runs - len(missing))
    if redis_url is not None and missing:
        made = jobs.over_workers(redis_url, experiment, missing)
    elif processes > 1:
        made = _over_processes(experiment, missing, processes)
    else:
        made = (run(experiment, i, names) for i, names in missing.items())
    for finished, records in enumerate(made, runs - len(missing) + 1):
        done.update({(record.run, record.method): record for record in records})
        if folder is not None:
            add_lines(folder / RUNS, [record.to_json() for record in records])
        on_progress(finished)
    return [done[i, name] for i in range(runs) for name in methods]


def _over_processes(experiment: Experiment, missing: Missing, processes: int) -> Iterator[list[Record]]:
    """Each run in one of `processes` new processes. They end when this one does, even if it is killed."""
    for name in THREADS:  # one thread each: the processes share the cores out
        os.environ.setdefault(name, "1")
    with workers(processes) as pool:
        for _, records in each_done(
            pool.submit(run, experiment, i, [*names]) for i, names in missing.items()
        ):
            yield records


@contextmanager
def workers(processes: int) -> Iterator[ProcessPoolExecutor]:
    """New processes for runs. They end when this one does, and at once where it is interrupted: a run that
    has to compile first takes minutes.
    """
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _end_with_parent) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise


def _end_with_parent() -> None:
    """Makes this process end when the process that started it is gone, whatever it is doing."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _open(folder: Path, experiment: Experiment) -> dict[tuple[int, str], Record]:
    """The records that `folder` holds. It is made, with a description of the experiment, where it is new."""
    folder.mkdir(parents=True, exist_ok=True)
    about, written = folder / ABOUT, folder / RUNS
    check(folder, experiment)
    if not about.exists():
        described = {**experiment.to_json(), "made_from": experiment.setting.made_from}
        replace_file(about, (json.dumps(described) + "\n").encode())
    return {(record.run, record.method): record for record in finished(written, Record.from_json)}


def finished(file: Path, make: Callable[[Any], T]) -> list[T]:
    """As `whole_lines`; nothing where there is no file. A last line that a kill has cut short is taken off,
    so that the next one can be added.
    """
    if not file.exists():
        return []
    os.truncate(file, file.read_bytes().rfind(b"\n") + 1)
    return whole_lines(file, make)


def whole_lines(file: Path, make: Callable[[Any], T]) -> list[T]:
    """What `make` makes of the JSON of each line; a last line that was cut short does not count. Raises
    InputError for a line that is damaged, or was written by a version whose records had other fields.
    """
    lines, found = file.read_bytes().split(b"\n")[:-1], list[T]()
    try:
        for line in lines:
            found.append(make(json.loads(line)))
    except (ValueError, TypeError, KeyError):
        number = len(found) + 1
        raise InputError(
            f"line {number} of {file} is not a run of this version", path="out",
            got=repr(lines[len(found)][:40]),
            expected="another --out; or delete that line, and its run is made again",
        ) from None  # fmt: skip
    return found


def add_lines(file: Path, values: Sequence[Any]) -> None:
    """Adds a line of JSON for each value, all in one write: the lines of two processes never mix."""
    with open(file, "ab") as lines:
        lines.write("".join(json.dumps(value) + "\n" for value in values).encode())


def check(folder: Path, experiment: Experiment) -> None:
    """Raises InputError where new records would not be comparable with those that the folder holds."""
    if not (folder / ABOUT).exists():
        if (folder / RUNS).exists():
            raise InputError(
                f"{folder} has runs, and no {ABOUT} that says of which experiment", path="out",
                got=str(folder), expected="another folder",
            )  # fmt: skip
        return
    found, made_from = read_about(folder)
    if found != experiment:
        raise InputError(
            "the folder holds another experiment", path="out", got=str(found.to_json()),
            expected=f"{experiment.to_json()}, or another folder",
        )  # fmt: skip
    if made_from is None:
        raise InputError(
            f"{folder} does not say which map, policies and model its records were made from", path="out",
            got=str(folder), expected="another --out; `specshield report` reads this one as it is",
        )  # fmt: skip
    now = experiment.setting.made_from
    changed = [name for name in {**made_from, **now} if made_from.get(name) != now.get(name)]
    if changed:
        raise InputError(
            f"the records in {folder} were made with another {', '.join(changed)}", path="out",
            got=changed, expected="another --out, or what those records were made with",
        )  # fmt: skip


def read_about(folder: Path) -> tuple[Experiment, dict[str, Any] | None]:
    """The experiment of a folder, and what its records were made from; None if the folder does not say it."""
    try:
        content = json.loads((folder / ABOUT).read_text())
        made_from = content.pop("made_from", None)
        return Experiment.from_json(content), made_from
    except (ValueError, TypeError, AttributeError):
        raise InputError(
            f"{folder / ABOUT} is no description of an experiment", path="out", got=str(folder),
            expected="a folder that `specshield evaluate --out` has written",
        ) from None  # fmt: skip


def read(folder: Path) -> list[Record]:
    """The records that a folder holds: the last for each run and method, no line that was cut off."""
    records = whole_lines(folder / RUNS, Record.from_json)
    return list({(record.run, record.method): record for record in records}.values())
