"""Run the quick tests with the lowest or the newest versions of what `pyproject.toml` declares.

    python tests/dependency_versions.py lowest --python python3.11

The tests run in an environment of the given Python that is made for them in a temporary folder. The lowest version of a
dependency is the lowest allowed one that has a wheel for this Python; what dependencies need themselves is the newest
that they accept. Other options go to pytest. The last line states the versions; the exit code is pytest's.
"""

import argparse
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]

#: Extras that quick tests need, or try where they are installed.
EXTRAS = ("movie", "test")


#: Beginning of the names of environments, and the age from which one is that of a killed run [s].
PREFIX, FORGOTTEN_S = "dependency-versions-", 24 * 3600.0


def requirements(*extras):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [*project["dependencies"], *(text for extra in extras for text in project["optional-dependencies"][extra])]
    return [one for one in map(Requirement, texts) if one.name != project["name"]]


def lowest(requirement, python):
    """Return the requirement with the lowest allowed version that has a wheel for this Python."""
    command = [python, "-m", "pip", "index", "versions", requirement.name, "--only-binary", ":all:"]
    listing = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    versions = re.search(r"^Available versions: (.+)$", listing, re.MULTILINE)[1].split(", ")
    allowed = list(requirement.specifier.filter(versions))
    if not allowed:
        sys.exit(f"{requirement}: no allowed version has a wheel for {python}")
    extras = f"[{','.join(requirement.extras)}]" if requirement.extras else ""
    return f"{requirement.name}{extras}=={min(allowed, key=Version)}"


def make_environment(folder, python, which):
    """Return the Python of a new environment with the package, and the versions of what `pyproject.toml` declares."""
    subprocess.run([python, "-m", "venv", folder], check=True)
    python = str(folder / "bin" / "python")
    # Older ones list versions without a wheel.
    install = [python, "-m", "pip", "install", "-q", "--no-compile", "--only-binary", ":all:"]
    subprocess.run([*install, "pip>=26"], check=True)
    wanted = [one for one in requirements(*EXTRAS) if one.marker is None or one.marker.evaluate()]
    pins = [lowest(one, python) for one in wanted] if which == "lowest" else []
    subprocess.run([*install, "-e", f"{ROOT}[{','.join(EXTRAS)}]", *pins], check=True)
    listing = subprocess.run(
        [python, "-m", "pip", "list", "--format", "json"], stdout=subprocess.PIPE, check=True
    ).stdout
    versions = {canonicalize_name(one["name"]): one["version"] for one in json.loads(listing)}
    return python, [f"{one.name} {versions[canonicalize_name(one.name)]}" for one in wanted]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("which", choices=("lowest", "newest"))
    parser.add_argument("--python", default=sys.executable, help="Python of the environment")
    given, options = parser.parse_known_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    for former in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        if time.time() - former.stat().st_mtime > FORGOTTEN_S:
            shutil.rmtree(former, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=PREFIX) as folder:
        python, versions = make_environment(Path(folder), given.python, given.which)
        about = subprocess.run([python, "-V"], stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
        tests = subprocess.run([python, "-m", "pytest", "-q", *options], cwd=ROOT, check=False)
    print(f"{given.which} on {about}: {', '.join(versions)}")
    sys.exit(tests.returncode)


if __name__ == "__main__":
    main()
