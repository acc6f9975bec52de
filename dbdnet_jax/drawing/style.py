"""What every drawing shares: colours that the colour-blind tell apart.

They are Okabe and Ito's (2008); those of the overlap go from light to dark as well.
"""

SOURCE, TARGET = "#E69F00", "#0072B2"  # orange, blue
GOOD, BAD = "#009E73", "#D55E00"  # bluish green, vermilion; never without a word beside them
NEUTRAL = "#9AA5AE"
OVERLAP = ("#CBD8E1", "#56B4E9", "#0072B2", "#00263C")  # probability 0 ... 1
# One line style for each method of a chart; yellow is too faint on white.
CURVES = ("#000000", "#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#7F7F7F", "#0072B2", "#D55E00")
DASHES = ("solid", "dash", "dot", "dashdot")
