"""Arrays from files, and documents of XML and JSON that others write."""

import zipfile

import h5netcdf
import numpy as np
import OpenEXR
from rows import each_row, must_refuse

from mitransient_lidar.core.formats.array_files import read_exr, read_netcdf, read_npy, read_npz
from mitransient_lidar.core.formats.documents import check_nesting, check_xml, parse_json, parse_toml

VALUES = np.arange(12.0).reshape(3, 4)


def npy(shape, version=1):
    """Return the header of an array in NumPy's format, without its values."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + len(text).to_bytes(2 if version == 1 else 4, "little") + text


SHAPES = ("(3, 4", "(3, -4)", "(3, 1e3)", "(3, {)", "(" * 200 + ")" * 200, "(10**9,)", "(3,)")


@each_row(*zip(map(npy, SHAPES)), npy("(3,)", version=9), b"\x93NUMPY", b"")
def test_damaged_arrays_are_refused_in_one_sentence(data, tmp_path):
    """NumPy's parser raises what Python's does: SyntaxError, TokenError, RecursionError, ..."""
    (tmp_path / "a.npy").write_bytes(data)
    must_refuse(r"a\.npy is damaged, or is not one array", read_npy, tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", data)
    must_refuse(r"a\.npz is damaged, or is not an archive", read_npz, tmp_path / "a.npz", ["a"])


def test_arrays_that_are_much_larger_than_their_file_are_refused(tmp_path):
    """By their headers: 2.4 GB of zeros are 3 MB of a compressed file."""
    (tmp_path / "a.npy").write_bytes(npy(f"({3 * 10**8},)"))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy("(300, 1000000)") + bytes(10**6))
    with h5netcdf.File(tmp_path / "a.nc", "w") as file:
        file.dimensions = {"x": 3 * 10**8}
        file.create_variable("a", ("x",), "f8", chunks=(10**6,), compression="gzip")
    # A file of three scan lines that claims to have 67 million of them.
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": VALUES.astype(np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    data = (tmp_path / "a.exr").read_bytes()
    window = b"dataWindow\0box2i\0\x10\0\0\0" + bytes(8)
    (tmp_path / "a.exr").write_bytes(data.replace(window + b"\3\0\0\0\2\0\0\0", window + b"\3\0\0\0\0\0\0\4"))
    must_refuse(r"a\.exr holds arrays of 1024 MiB, and 256 MiB are the most", read_exr, tmp_path / "a.exr")
    for read, name in ((read_npy, "a.npy"), (lambda path: read_npz(path, ["a"]), "a.npz"), (read_netcdf, "a.nc")):
        must_refuse(rf"{name} holds arrays of 2289 MiB, and 256 MiB are the most", read, tmp_path / name)


#: Nine levels of ten references each, of a billion letters.
LAUGHS = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))


@each_row(
    ('<!DOCTYPE a [<!ENTITY e "&#60;include/>">]><a>&e;</a>', "a DOCTYPE"),
    (f'<!DOCTYPE a [<!ENTITY e0 "x">{LAUGHS}]><a>&e9;</a>', "a DOCTYPE"),
    ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "a DOCTYPE"),
    ("<?include part.xml?><a/>", "a processing instruction"),
    ("<a><?x?></a>", "a processing instruction"),
    ("<a>&e;</a>", "not well-formed XML: undefined entity"),
    ("<a>", "not well-formed XML"),
    ("", "not well-formed XML"),
)
@each_row(str, lambda text: text.encode("utf-16"))
def test_xml_holds_elements_attributes_and_comments(encode, text, what):
    """The search for ``<!DOCTYPE`` in the bytes of a file does not find it in UTF-16."""
    must_refuse(rf"^a file (holds|is) {what}", lambda: check_xml(encode(text), "a file"))


def test_plain_xml_is_let_through_and_one_that_cannot_be_encoded_is_not():
    check_xml('<?xml version="1.0" encoding="UTF-8"?><!-- a --><a b="c"><d>e &amp; &#955;</d></a>', "a file")
    must_refuse("a file is not well-formed XML", check_xml, "<a b='\ud800'/>", "a file")


@each_row(120, 300, 480, 600, 5000)
def test_deep_documents_are_refused(depth):
    nested = "[" * depth + "]" * depth
    must_refuse("a text is nested more than 100 deep", parse_json, nested, "a text")
    must_refuse("a file is nested more than 100 deep", parse_toml, f"a = {nested}", "a file")


def test_nesting_is_counted():
    nested: object = 1
    for _ in range(100):
        nested = {"a": [nested]} if isinstance(nested, list) else [nested]
    must_refuse("x is nested more than 100 deep", check_nesting, nested, "x")
    check_nesting({"a": [[1], {"b": "text"}], "c": "[" * 200}, "x")
