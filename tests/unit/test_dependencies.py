"""Packages that are imported against those that `pyproject.toml` declares, and code against its planted faults."""

import re
import sys

from dependency_versions import ROOT, requirements
from packaging.utils import canonicalize_name
from planted_faults import FAULTS

#: Packages by their modules, where the names differ.
PACKAGES = {"PIL": "pillow"}

#: Dependencies that no file imports: a shared library, what builds the wheel in a test, and a plugin of pytest.
NOT_IMPORTED = {"karellen-llvm-core", "setuptools", "pytest-xdist"}

#: Packages that tests import where they are installed: of tests with a browser, and a second reader of LAS files.
OPTIONAL = {"selenium", "lazpy"}


#: A line that imports, which takes a tenth of the time of a syntax tree to find.
IMPORT = re.compile(r"^ *(?:import (?=[\w.]+(?: as \w+)?$)|from (?=[\w.]+ import ))(\w+)", re.MULTILINE)


def declared(*extras):
    """Return the names of the dependencies and of those of extras, as package indices normalise them."""
    return {canonicalize_name(requirement.name) for requirement in requirements(*extras)}


def imported(*folders):
    """Return the names of the packages whose modules the Python files of folders import, at any depth of the code."""
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    own = {"mitransient_lidar", *(path.stem for path in (ROOT / "tests").iterdir())}
    names = {name for file in files for name in IMPORT.findall(file.read_text("utf-8"))} - own - sys.stdlib_module_names
    return {canonicalize_name(PACKAGES.get(name, name)) for name in names}


def test_the_package_imports_what_it_declares_and_nothing_else():
    """The scripts among the example files of `scenes` name what they need besides."""
    assert imported("mitransient_lidar", "plugins") == declared("movie") - NOT_IMPORTED


def test_the_tests_import_what_their_extra_declares_and_nothing_else():
    found = imported("tests")
    assert found <= declared("movie", "test") | OPTIONAL
    assert declared("test") - declared() - found - declared("movie") == NOT_IMPORTED - declared()


def test_planted_faults_are_where_their_code_is():
    """Those of a code that has moved would plant nothing."""
    for fault in FAULTS:
        assert (ROOT / fault.file).read_text("utf-8").count(fault.old) == fault.count, fault.name
