"""`python -m evaluation evaluate | results | rewards | report ...`, where nothing is installed."""

from evaluation.commands import curves, evaluate, mujoco, report, results, rewards, worlds
from specshield.cli import run

if __name__ == "__main__":
    run([evaluate, worlds, mujoco, results, rewards, curves, report])
