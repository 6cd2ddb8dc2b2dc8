"""Arrays from files; damaged files are covered by the tests of height maps."""

import zipfile

import h5netcdf
import numpy as np
import OpenEXR
from rows import each_row, must_refuse

from mitransient_lidar.core.formats.array_files import read_exr, read_netcdf, read_npy, read_npz

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
