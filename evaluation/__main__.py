"""`python -m evaluation evaluate | worlds | report ...`, where nothing is installed."""

from evaluation.commands import evaluate, mujoco, report, worlds
from specshield.cli import run

if __name__ == "__main__":
    run([evaluate, worlds, mujoco, report])
