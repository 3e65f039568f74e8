"""The colours that all figures share."""

WALL, INK, FAINT = "#343840", "#282b32", "#9ea0a5"
VISIT, AVOID, TINT = "#2b8a5a", "#c63c3c", 0.16  # regions, and how opaque they are
TARGET = "#f6be28"  # what the model looks for
BLUE, ORANGE, GREY = "#2563c8", "#e27d22", "#b4b4b4"  # ways; grey: after the rule's horizon
