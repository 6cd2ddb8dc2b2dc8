"""Reference files of tests: what figures contain, and the parameters of shipped scenes.

After a change of them that is meant, ``python tests/references.py`` writes the files anew. Look at their difference
before you commit it.
"""

import json
import sys
from pathlib import Path

TESTS = Path(__file__).parent
FIGURES = TESTS / "unit" / "plots" / "figures.json"
SCENES = TESTS / "unit" / "loading" / "shipped_scenes.json"


def read(path):
    return json.loads(path.read_text("utf-8"))


def scene_parameters():
    """Return the parameters of ``table1``, and what every other shipped scene has otherwise, or lacks."""
    from mitransient_lidar.loading import catalogue

    found = {name: _plain(catalogue.scene_parameters(name, by_id=True)) for name in catalogue.scene_names()}
    table = found["table1"]
    other = {
        name: {key: own.get(key) for key in sorted({*table, *own}) if own.get(key) != table.get(key)}
        for name, own in found.items()
    }
    return other | {"table1": table}


def _plain(parameters):
    """Return parameters without their second names, which begin with the id or the name of a plugin."""
    second = {name.replace(".", "_") for name in parameters if "." in name}
    return {name: value for name, value in parameters.items() if "." not in name and name not in second}


def main():
    """Write the files, the parts of each figure line by line, and a line for each scene."""
    sys.path.insert(0, str(TESTS))
    from drawn_figures import described
    from figure_inputs import FIGURES as DRAWN

    def line(value):
        return json.dumps(value, ensure_ascii=False)

    figures = [f"{line(name)}: [\n" + ",\n".join(map(line, described(draw()))) + "\n]" for name, draw in DRAWN.items()]
    scenes = [f"{line(name)}: {line(own)}" for name, own in sorted(scene_parameters().items())]
    for path, entries in ((FIGURES, figures), (SCENES, scenes)):
        path.write_text("{\n" + ",\n".join(entries) + "\n}\n", "utf-8")


if __name__ == "__main__":
    main()
