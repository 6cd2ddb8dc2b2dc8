"""What `pyproject.toml` cannot state: the commit of a build, and README without links to files of the repository."""

from __future__ import annotations

import re
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).parent
VERSION: dict[str, object] = {"__file__": str(ROOT / "mitransient_lidar" / "_version.py")}
exec((ROOT / "mitransient_lidar" / "_version.py").read_text("utf-8"), VERSION)


def write_commit(folder: Path) -> None:
    """Write the commit of this checkout, if it is one, where `_version.commit` looks for it."""
    if commit := VERSION["commit"]():
        (folder / "mitransient_lidar" / "commit.txt").write_text(f"{commit}\n", "utf-8")


class _BuildWithCommit(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            write_commit(Path(self.build_lib))


class _SdistWithCommit(sdist):
    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        write_commit(Path(base_dir))


def long_description() -> str:
    """Return README without pictures, with the texts of relative links."""
    text = re.sub(r"^!\[[^]]*\]\((?!\w+:).*\)\n\n", "", (ROOT / "README.md").read_text("utf-8"), flags=re.MULTILINE)
    return re.sub(r"\[([^]]*)\]\((?!\w+:)[^)]*\)", r"\1", text)


setup(
    cmdclass={"build_py": _BuildWithCommit, "sdist": _SdistWithCommit},
    long_description=long_description(),
    long_description_content_type="text/markdown",
)
