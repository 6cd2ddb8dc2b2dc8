"""Files that others name: what is opened, and what is printed of their names."""

import os
import socket
import threading

import h5py
import numpy as np
import pytest
from rows import each_row, must_refuse

from mitransient_lidar.core.errors import LINES, UserError, printable
from mitransient_lidar.core.files import (
    check_encodable,
    check_regular,
    check_tree,
    is_file_name,
    open_file,
    open_log,
    read_text,
)
from mitransient_lidar.core.formats.array_files import check_hdf5, read_netcdf, read_npy

#: What stands in the place of a file, by the words of the sentence.
OTHERS = ("a named pipe", "a device", "a socket", "Is a directory", "No such file", "Too many levels", "NUL")


@pytest.fixture(params=OTHERS)
def other(request, tmp_path, monkeypatch):
    """What is not a regular file, and a part of the sentence that refuses it."""
    path = tmp_path / "other"
    match request.param:
        case "a named pipe":
            os.mkfifo(path)
        case "a device":
            path.symlink_to("/dev/zero")
        case "a socket":
            # Names of sockets have at most 107 bytes.
            monkeypatch.chdir(tmp_path)
            with socket.socket(socket.AF_UNIX) as server:
                server.bind("other")
        case "Is a directory":
            path.mkdir()
        case "Too many levels":
            path.symlink_to("other")
        case "NUL":
            path = tmp_path / "a\0b"
    return path, request.param


@each_row(open_file, check_regular, read_text, read_npy)
def test_only_regular_files_are_opened(read, other):
    path, reason = other
    with pytest.raises(UserError, match=reason) as caught:
        read(path)
    assert "\0" not in str(caught.value)


def test_a_file_that_becomes_a_pipe_after_its_check_is_refused(tmp_path, monkeypatch):
    """The state of the open file counts; opening a pipe does not wait for a writer."""
    os.mkfifo(tmp_path / "pipe")
    regular = os.stat(__file__)
    monkeypatch.setattr("mitransient_lidar.core.files.os.stat", lambda path: regular)
    must_refuse("it is a named pipe", open_file, tmp_path / "pipe")


def test_a_folder_with_links_or_pipes_is_refused(tmp_path):
    folder = tmp_path / "store"
    (folder / "a" / "b").mkdir(parents=True)
    (folder / "a" / "b" / "chunk").write_bytes(b"")
    check_tree(folder)
    for name in ("link", "a/link", "a/b/link"):
        (folder / name).symlink_to(folder / "a")
        must_refuse(f"{name} is a link, and no link in it is followed", check_tree, folder)
        (folder / name).unlink()
    os.mkfifo(folder / "a" / "pipe")
    must_refuse("a/pipe: it is a named pipe", check_tree, folder)


@pytest.mark.parametrize("place", ["link", "dangling link", "pipe", "folder"])
def test_a_log_is_no_link(tmp_path, place):
    """A store of a stranger would otherwise add lines to any file of whoever completes it."""
    log, victim = tmp_path / "a.zarr.log", tmp_path / "victim"
    if place == "folder":
        log.mkdir()
    elif place == "pipe":
        os.mkfifo(log)
    else:
        log.symlink_to(victim)
    if place == "link":
        victim.write_text("mine")
    with pytest.raises((OSError, UserError)):
        open_log(log)
    assert not victim.exists() or victim.read_text() == "mine"


def test_a_pipe_that_someone_reads_is_no_log(tmp_path):
    log = tmp_path / "a.zarr.log"
    os.mkfifo(log)
    descriptor = os.open(log, os.O_RDONLY | os.O_NONBLOCK)
    must_refuse("it is a named pipe", open_log, log)
    os.close(descriptor)


@pytest.fixture(params=["external", "link", "nested link", "virtual"])
def referring(request, tmp_path):
    """NetCDF file whose values lie in another file."""
    other, path = tmp_path / "other", tmp_path / "a.nc"
    with h5py.File(other, "w") as file:
        file["a"] = np.zeros(3)
    with h5py.File(path, "w") as file:
        match request.param:
            case "external":
                file.create_dataset("a", (3,), "f8", external=[(str(other), 0, 24)])
            case "link":
                file["a"] = h5py.ExternalLink(str(other), "/a")
            case "nested link":
                file.create_group("b/c")["a"] = h5py.ExternalLink(str(other), "/a")
                file["b/c/up"] = file["b"]
            case "virtual":
                layout = h5py.VirtualLayout((3,), "f8")
                layout[:] = h5py.VirtualSource(str(other), "a", (3,))
                file.create_virtual_dataset("a", layout)
    return path


def test_values_in_other_files_are_refused(referring):
    for read in (check_hdf5, read_netcdf):
        must_refuse(r"into another file|in other files", read, referring)


def test_values_in_a_pipe_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.create_dataset("a", (3,), "f8", external=[(str(tmp_path / "pipe"), 0, 24)])
    refused = []

    def read():
        try:
            read_netcdf(tmp_path / "a.nc")
        except UserError as error:
            refused.append(str(error))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(timeout=60)
    assert len(refused) == 1


@each_row("", ".", "..", "a/b", "../a", "/a", "a\\b", "a\nb", "a\0", "\x1b[2J", "x" * 201, 3, None)
def test_names_of_more_than_a_file(name):
    assert not is_file_name(name)


@pytest.mark.parametrize("name", ["a\nb.nc", "a\x1b[31m.nc", "\u202egpj.nc", "a\x9b.nc"])
def test_names_of_outputs_have_no_control_characters(tmp_path, name):
    with pytest.raises(UserError, match="must have no control characters") as caught:
        check_encodable(tmp_path / name)
    assert printable(str(caught.value)) == str(caught.value)


def test_control_characters_are_written_out():
    text = "a\x1b[31mb\x07\x9b\x7f\r\n\t\u202e\u2066\u2028\udc80é–µ"
    assert printable(text) == r"a\x1b[31mb\x07\x9b\x7f\r\n\t\u202e\u2066\u2028\udc80é–µ"
    assert printable("a\nb\tc\r", kept=LINES) == "a\nb\tc\\r"


def test_sentences_are_printable_and_short():
    error = UserError("a\x1b]0;title\x07 = " + "x" * 10**6 + " must be a number")
    assert str(error).startswith(r"a\x1b]0;title\x07 = xxx")
    assert str(error).endswith("xxx must be a number")
    assert len(str(error)) < 2001
