"""`python -m evaluation evaluate | results | report ...`, where nothing is installed."""

from evaluation.commands import evaluate, mujoco, report, results, worlds
from specshield.cli import run

if __name__ == "__main__":
    run([evaluate, worlds, mujoco, results, report])
