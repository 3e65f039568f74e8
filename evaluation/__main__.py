"""`python -m evaluation evaluate | results | rewards | report ...`, where nothing is installed."""

from evaluation.commands import curves, evaluate, habits, mujoco, report, results, rewards, rivals, worlds
from specshield.cli import run

if __name__ == "__main__":
    run([evaluate, worlds, mujoco, results, rewards, curves, habits, rivals, report])
