"""The commands that this package adds to `specshield`. Each imports what it needs when it runs."""

from __future__ import annotations

import os
from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from specshield.cores import cores
from specshield.errors import InputError, Unsupported
from specshield.service.library.files import check_writable


def evaluate(
    case: Annotated[str, typer.Option(help="A case of maps/, as 1 or case1; or house.")],
    runs: Annotated[int, typer.Option(help="Runs, each by every method.", min=1)] = 100,
    seed: Annotated[int, typer.Option(help="Decides starts, model, draws and noise.", min=0)] = 0,
    methods: Annotated[
        str,
        typer.Option(
            help="Some of them, as paper,ours; NAME@M/K: margin M metres, slack K steps; NAME@conformal/K: a "
            "margin that 60 other runs measure; NAME@default: as a session is by default; "
            "NAME@episode/D, NAME@default/D: threshold D over the episode; "
            "NAME@step/D: at each step; NAME@robustness/D: of D metres of robustness."
        ),
    ] = "",
    noise: Annotated[
        str, typer.Option(help="none, gaussian, rough, slip, short, obstacle, shift, collider; or some.")
    ] = "none",
    model: Annotated[str, typer.Option(help="The model that is to be kept to the rule.")] = "learned",
    house: Annotated[
        str | None,
        typer.Option(help="For the case house: drawn_N, a floor plan drawn with seed N, or one of --houses."),
    ] = None,
    houses: Annotated[
        Path | None, typer.Option(help="A folder with ProcTHOR houses and their asset-sizes.json.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to keep results in and to take them up from.")
    ] = None,
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
    redis: Annotated[
        str | None,
        typer.Option(help="Let the workers of this Redis do the runs instead.", envvar="REDIS_URL"),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print figures and records as JSON.")] = False,
) -> None:
    """Compare methods on one case, over any number of runs."""
    if redis is not None:
        os.environ["REDIS_URL"] = redis
        import_module("specshield.service.training")  # before rq: in a cluster its keys have other names
    from evaluation import campaigns
    from evaluation.experiment import available, experiments
    from evaluation.houses import located

    status = campaigns.evaluate(
        experiments(case, located(house, houses), model, noise, seed),
        runs,
        methods.split(",") if methods else available(case),
        out,
        processes or cores(),
        redis,
        json,
    )
    raise typer.Exit(status)


def mujoco(
    case: Annotated[str, typer.Option(help="Cases, as 1,2,drawn_3.")] = "1,2,drawn_3",
    runs: Annotated[int, typer.Option(help="Runs of each case.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Decides starts, model, draws and wheels.", min=0)] = 0,
) -> None:
    """Drive a wheeled base in MuJoCo, of the extra `mujoco`: its residuals, and what is kept."""
    if find_spec("mujoco") is None:
        raise Unsupported("this command needs mujoco: pip install -e './evaluation[mujoco]'")
    from evaluation.worlds import physical

    typer.echo(physical.report(physical.named_cases(case), runs, seed))


def worlds(
    case: Annotated[str, typer.Option(help="Cases, as 1 or case1; drawn_N; a house's JSON file.")] = "case1",
    world: Annotated[
        str, typer.Option(help="Some of told, obstacle, shift, collider, person.")
    ] = "obstacle,shift,collider,person",
    sensing: Annotated[str, typer.Option(help="Some of scan, contact, none.")] = "scan,contact",
    runs: Annotated[int, typer.Option(help="Runs of each.", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="Decides starts, model, draws and worlds.", min=0)] = 0,
    slack: Annotated[
        int, typer.Option(help="Steps that every F keeps, in place of what the session learns.", min=-1)
    ] = -1,
    robot: Annotated[str, typer.Option(help="Some of stretch, locobot, trailing, arcs.")] = "stretch",
    out: Annotated[Path | None, typer.Option(help="Folder to keep runs in and to take them up from.")] = None,
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
) -> None:
    """Measure how often sessions keep the rule in worlds other than told, beside an oracle told the truth."""
    from evaluation.worlds.campaign import compare
    from evaluation.worlds.robots import ROBOTS
    from evaluation.worlds.runs import SENSING, Trial, known
    from evaluation.worlds.world import WORLDS
    from specshield.sim.cases import case_name

    cases = [each if each.endswith(".json") else case_name(each) for each in case.split(",")]
    for each in cases:  # one that does not exist is refused now, and not after hours of runs
        known(each)
    trials = [
        Trial(each, name, senses, seed, slack < 0, max(slack, 0), robot=body)
        for body in _some(robot, ROBOTS, "--robot")
        for each in cases
        for name in _some(world, WORLDS, "--world")
        for senses in _some(sensing, SENSING, "--sensing")
    ]
    compare(trials, runs, out, processes or cores())


def results(
    out: Annotated[Path, typer.Option(help="Folder to keep results in and to take them up from.")] = Path(
        "out/results"
    ),
    page: Annotated[Path, typer.Option(help="The page that summarises; others go beside it.")] = Path(
        "docs/results.md"
    ),
    houses: Annotated[Path, typer.Option(help="A folder with ProcTHOR houses, if there is one.")] = Path(
        "../shared/data/houses"
    ),
    only: Annotated[str, typer.Option(help="Some of cases, noise, bodies, houses, models, tasks.")] = "",
    share: Annotated[
        float, typer.Option(help="Share of the runs, for a first look.", min=0.0, max=1.0)
    ] = 1.0,
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
) -> None:
    """Run every campaign of the results pages, and write them."""
    from evaluation.houses import houses_in
    from evaluation.plan import carry_out

    _check_page(page)
    kinds = _some(only, ("cases", "noise", "bodies", "houses", "models", "tasks"), "--only") if only else []
    found = houses_in(houses)
    if not found and (not kinds or "houses" in kinds):
        typer.echo(f"no ProcTHOR houses are in {houses}: they are left out", err=True)
    failed = carry_out(out, page, found, kinds, share, processes or cores())
    raise typer.Exit(1 if failed else 0)


def uncertainty(
    only: Annotated[
        str,
        typer.Option(help="Some of noise, worlds, forms, thresholds, mujoco, switches, robots, yardstick."),
    ] = "",
    share: Annotated[
        float, typer.Option(help="Share of the runs, for a first look.", min=0.0, max=1.0)
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Decides all that is drawn in every campaign.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder to keep figures in and to take them up from.")] = Path(
        "out/uncertainty"
    ),
    page: Annotated[Path, typer.Option(help="The page to write.")] = Path("docs/results/uncertainty.md"),
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
) -> None:
    """Measure sessions whose robot or map is not as they were told, and write the page of it.

    What is not measured now stays on the page as it was: its figures are kept beside it.
    """
    from evaluation.uncertainty.figures import beside, carry_out, keep_beside
    from evaluation.uncertainty.page import write
    from evaluation.uncertainty.plan import PARTS

    _check_page(page)
    parts = _some(only, PARTS, "--only") if only else []
    before = beside(page)
    found, failed = carry_out(out, parts, share, seed, processes or cores())
    found = {**before, **found}
    write(page, found, seed)
    keep_beside(page, found)
    raise typer.Exit(1 if failed else 0)


def rewards(
    case: Annotated[str, typer.Option(help="Cases, as 1,2.")] = "1,2",
    reward: Annotated[str, typer.Option(help="Some of paper, progress.")] = "paper,progress",
    seeds: Annotated[str, typer.Option(help="Seeds of the trainings, as 0,1,2.")] = "0,1,2",
    updates: Annotated[int, typer.Option(help="Updates of each training; `train` makes 16000.")] = 16_000,
    runs: Annotated[int, typer.Option(help="Runs by the paper's rule with each network.", min=1)] = 50,
    out: Annotated[
        Path, typer.Option(help="Folder of the networks; what it holds is not made again.")
    ] = Path("out/rewards"),
    page: Annotated[Path, typer.Option(help="The page to write.")] = Path("docs/rewards.md"),
) -> None:
    """Train the learned policy with the paper's reward and with ours, and compare what comes of them."""
    from evaluation.rewards import REWARDS, all_of, compare
    from specshield.sim.cases import load_case

    _check_page(page)
    _some(reward, REWARDS, "--reward")
    numbers = _numbers(seeds, "--seeds")
    if not all(number >= 0.0 and number.is_integer() for number in numbers):
        raise InputError(
            "not all are whole numbers of 0 or more", path="--seeds", got=seeds, expected="as 0,1"
        )
    trainings = all_of(case, reward, [int(number) for number in numbers], updates)
    for each in trainings:  # a case that does not exist is refused now, and not after hours of training
        load_case(each.case)
    compare(trainings, runs, out, page)


def curves(
    case: Annotated[str, typer.Option(help="Cases, as 1,2.")] = "1,2",
    model: Annotated[str, typer.Option(help="Models, as learned,goal-seeker.")] = "learned,unsteered",
    thresholds: Annotated[
        str, typer.Option(help="Thresholds, each used over a step and over the episode; above 0, at most 1.")
    ] = "0.25,0.5,0.75,0.9,1",
    metres: Annotated[str, typer.Option(help="Thresholds on the robustness, in metres.")] = "-0.5,0,0.1,0.2",
    runs: Annotated[int, typer.Option(help="Runs of each point.", min=1)] = 60,
    seed: Annotated[int, typer.Option(help="Decides starts, model and draws.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the runs; what it holds is not made again.")] = Path(
        "out/curves"
    ),
    page: Annotated[Path, typer.Option(help="The page to write, with its figure beside it.")] = Path(
        "docs/curves.md"
    ),
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
) -> None:
    """Measure how often thresholds below 1, or in metres, keep the rule, and what they cost."""
    from evaluation.curves import draw_all
    from evaluation.experiment import Experiment
    from specshield.sim.cases import case_name

    _check_page(page)
    asked = [
        Experiment(case_name(one), model=name, seed=seed)
        for one in case.split(",")
        for name in model.split(",")
    ]
    for each in asked:  # a case that does not exist is refused now, and not after hours of runs
        _ = each.setting
    draw_all(
        asked,
        _numbers(thresholds, "--thresholds"),
        _numbers(metres, "--metres"),
        runs,
        out,
        page,
        processes or cores(),
    )


def habits(
    runs: Annotated[int, typer.Option(help="Runs, each by every method.", min=1)] = 60,
    seed: Annotated[int, typer.Option(help="Decides starts, model and draws.", min=0)] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the runs; what it holds is not made again.")] = Path(
        "out/habits"
    ),
    page: Annotated[Path, typer.Option(help="The page to write.")] = Path("docs/habits.md"),
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
) -> None:
    """Measure what shields break of a model's habit and of its memory."""
    from evaluation.habits import measure

    _check_page(page)
    measure(runs, seed, out, page, processes or cores())


def rivals(
    runs: Annotated[int, typer.Option(help="Runs of each model and case.", min=1)] = 60,
    seed: Annotated[int, typer.Option(help="Decides starts, model and draws.", min=0)] = 3,
    model: Annotated[str, typer.Option(help="Models, as bot,learned; else six, of several families.")] = "",
    case: Annotated[str, typer.Option(help="Cases, or drawn houses, as case1,drawn_1.")] = "case1,case2",
    out: Annotated[Path, typer.Option(help="Folder of the runs; what it holds is not made again.")] = Path(
        "out/rivals"
    ),
    page: Annotated[Path, typer.Option(help="The page to write.")] = Path("docs/rivals.md"),
    processes: Annotated[int, typer.Option(help="Processes; 0: one a core.", min=0)] = 0,
) -> None:
    """Measure look-ahead beside slacks of four kinds, and say whether it wins."""
    from evaluation.rivals import FAMILIES, measure

    _check_page(page)
    models = model.split(",") if model else FAMILIES
    measure(runs, seed, models, case.split(","), out, page, processes or cores())


def report(
    results: Annotated[Path, typer.Argument(help="Folder that evaluate has kept results in.")],
    out: Annotated[Path, typer.Option(help="The page to write; figures go into a folder beside it.")] = Path(
        "docs/results.md"
    ),
) -> None:
    """Write a page with tables and figures from what evaluate has measured."""
    from evaluation import writeup

    writeup.write_up(results, out)
    typer.echo(f"page: {out}")


def _check_page(page: Path) -> None:
    """Makes the folder of a page if need be. Raises InputError where the page cannot be written, since what
    it is written from may take hours.
    """
    check_writable(page.parent, "--page")
    if page.is_dir():
        raise InputError("this is a folder", path="--page", got=str(page), expected="a file to write")


def _some(text: str, known: Iterable[str], option: str) -> list[str]:
    """The names in a text, all of which have to be known."""
    found, names = text.split(","), list(known)
    for name in found:
        if name not in names:
            expected = f"some of {','.join(names)}"
            raise InputError("there is no such name", path=option, got=name, expected=expected)
    return found


def _numbers(text: str, option: str) -> list[float]:
    try:
        return [float(value) for value in text.split(",")]
    except ValueError:
        raise InputError("not all are numbers", path=option, got=text, expected="as 0.5,1") from None
