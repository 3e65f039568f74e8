"""`python -m evaluation evaluate | results | rewards | report ...`, where nothing is installed."""

from evaluation import commands
from specshield.cli import run

if __name__ == "__main__":
    run(
        [
            commands.evaluate, commands.worlds, commands.mujoco, commands.results, commands.uncertainty,
            commands.rewards, commands.curves, commands.habits, commands.rivals, commands.report,
        ]
    )  # fmt: skip
