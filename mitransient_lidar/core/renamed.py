"""Former names of commands and functions, and those that have taken their place."""

#: Commands.
COMMANDS = {
    "sweep": "campaign",
    "waveforms": "echoes",
    "plot": "view --plot",
    "shot-statistics": "shots --figure",
    "instruments": "scenes instruments",
}

#: Public functions in the package.
FUNCTIONS = {
    "depth_uncertainty": "tpu",
    "sweep": "campaign",
    "waveforms": "echoes",
}
