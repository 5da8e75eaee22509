"""The model: `streamsplat.py` reads as the paper's figure, and each stage that all networks share has a file.

Stages do not import each other; `views` holds the arrays that they exchange. `network.py` has the protocol of a
network; `compact.py` and `resplat/` are networks.
"""
