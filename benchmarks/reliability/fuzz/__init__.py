"""Inputs that no honest caller sends."""
