"""Robots: action sets and the known dynamics."""

from specshield.robot.actions import PRESETS, STRETCH, Action, Robot, robot_from_json, robot_to_json
