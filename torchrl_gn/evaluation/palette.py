"""Colours that all figures and videos share."""

TRUTH = "#3b6ea5"
PREDICTION = "#e0752d"
AXES = ("#c23b4b", "#2e8b57", "#3b6ea5", "#8a5fbf")  # x, y, z and one more for quaternions
SERIES = (TRUTH, PREDICTION, "#c23b4b", "#2e8b57", "#8a5fbf", "#b0892a", "#3fa3a3")  # lines or bars side by side
INK = "#2b2f36"
MUTED = "#8b929c"
GRID = "#dfe3e8"
PAPER = "#fbfbfc"
