"""`python -m evaluation evaluate ...` and `python -m evaluation report ...`, where nothing is installed."""

from evaluation.commands import evaluate, mujoco, report
from specshield.cli import run

if __name__ == "__main__":
    run([evaluate, mujoco, report])
