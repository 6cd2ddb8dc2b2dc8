"""Which existing files each command replaces, and which it keeps before it renders."""

import functools
import os
import shutil

import pytest
import synthetic_shots
from command_line import COMMANDS, MADE, assert_refused, run, stub

from mitransient_lidar import results
from mitransient_lidar.cli import files, overwriting
from mitransient_lidar.core.marks import holds_mark, read_mark, write_mark

#: Wrong options, found after the check of the files and before the render.
WRONG = ["-D", "no_such_parameter=1"]
OTHER = {"scene": "fig09_2x2"}

INSTRUMENT = {"instrument": "other"}


def figure(*words, files=("png", "nc"), other=OTHER):
    """Return the row of a command that draws a figure, and its data beside it."""
    return [*words, *WRONG, "-o", f"d/f.{files[0]}"], [f"d/f.{end}" for end in files], other


#: For each command: its arguments, which fail once the files may be written; its files; what another subject is.
GATES = ("gates.exr", "gates.png", "depth.png", "gates.gif", "gates.html", "components.png")
FRAMES = (".nc", "_gates.exr", "_gates.png", "_depth.png")
CASES = {
    "render": (
        ["table1", *WRONG, "-o", "d"],
        [f"d/table1{end}" for end in (".exr", ".nc", ".png", "_layout.png")],
        OTHER,
    ),
    "render gates": (
        ["gated_mine", "--gif", "--html", "--components", *WRONG, "-o", "d"],
        [f"d/gated_mine_{name}" for name in GATES],
        OTHER,
    ),
    "render instrument": (
        ["table1", "--instrument", "riegl_vq840g", *WRONG, "-o", "d"],
        ["d/table1.nc"],
        {"instrument": ""},
    ),
    "frames": (["gated_mine", *WRONG, "-o", "d"], [f"d/gated_mine_frames{end}" for end in FRAMES], OTHER),
    "passive": (
        ["passive_sea", *WRONG, "-o", "d"],
        [f"d/passive_sea_passive{end}" for end in (".nc", ".exr", ".png")],
        OTHER,
    ),
    "shots": (["table1", *WRONG, "-o", "d/s.nc", "--figure", "d/f.svg"], ["d/s.nc", "d/f.svg", "d/f.nc"], OTHER),
    "find-shots": figure("table1", files=["png"]),
    "detect": figure("fig13_2x2", files=("pdf", "nc")),
    "depth-bias": (["riegl_vq840g", *WRONG, "-o", "d/t.nc", "--figure", "d/t.png"], ["d/t.nc", "d/t.png"], INSTRUMENT),
    "tpu": (
        ["riegl_vq840g", *WRONG, "-o", "d"],
        [f"d/riegl_vq840g_{end}" for end in ("tpu.nc", "150m_20deg_tvu.csv", "150m_20deg_orders.png")],
        INSTRUMENT,
    ),
    "forecast": figure("riegl_vq840g", "1:3", files=("png", "nc", "tif"), other=INSTRUMENT),
    "bounds": figure("table1", "--free", "bottom_depth", files=("png", "nc", "csv")),
    "scattering": figure("table1"),
    "scenes water": (["jerlov", "no_such_type", "-o", "d/f.png"], ["d/f.png"], {"kind": "petzold"}),
    "figures": (["fig09", "--target-error", "-1", "-o", "d"], ["d/fig09.png", "d/statements.csv"], None),
    "view": (["damaged.nc", "-o", "d/v.html", "--no-browser"], ["d/v.html"], OTHER),
    "view plot": (["damaged.nc", "--plot"], ["damaged.png"], OTHER),
    "view layout": (["damaged.nc", "--layout"], ["damaged_layout.png"], OTHER),
    "compare": (["damaged.nc", "damaged.exr", "-o", "d/c.png"], ["d/c.png"], {"second_scene": "fig09_2x2"}),
    "record": (["damaged.nc"], ["damaged_recorded.nc"], OTHER),
    "echoes": (["damaged.nc", "--csv", "d/e.csv"], ["d/e.csv"], None),
    "retrieve": (["damaged.nc", "-o", "d/r.nc", "--figure", "d/r.png"], ["d/r.nc", "d/r.png"], OTHER),
    "gates": (
        ["shot.nc", "--start-ns", "1", "--width-ns", "-1", "--sequence", "--html", "-o", "d"],
        ["d/shot_gates.exr", "d/shot_gates.png", "d/shot_depth.png", "d/shot_gates.html", "d/shot_gate000.exr"],
        OTHER,
    ),
    "fit": (
        ["damaged.nc", "--scene", "table1", "--free", "bottom_depth", *WRONG, "-o", "d"],
        ["d/fit.nc", "d/fit.csv", "d/fit.png"],
        OTHER,
    ),
    "campaign row": (["missing.toml", "--row", "1", "-o", "d/r.nc"], ["d/r.nc"], {"campaign": "other"}),
    "campaign show": (["missing.zarr", "--show", "-o", "d/r.png"], ["d/r.png"], {"campaign": "other"}),
    "fly": (
        ["missing.toml", "-o", "d"],
        [f"d/{name}" for name in ("points.laz", "waveforms.las", "waveforms.wdp", "flight.png", "profile.png")],
        {"flight": "other"},
    ),
}
FILES = [(name, file) for name, (_, targets, _) in CASES.items() for file in targets]


def words(name):
    return name if name in COMMANDS else name.split()[0]


def command(name, *more):
    return run(words(name), *CASES[name][0], *more)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, small_result):
    """A working folder with a result, damaged ones, and a folder for files."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d").mkdir()
    shutil.copy(small_result, tmp_path / "shot.nc")
    for name in ("damaged.nc", "damaged.exr"):
        (tmp_path / name).write_text("no result")
    return tmp_path


@pytest.fixture(scope="module")
def small_result(tmp_path_factory):
    path = tmp_path_factory.mktemp("result") / "shot.nc"
    results.save(synthetic_shots.result(scene="table1"), path)
    return path


@pytest.fixture
def write_before(monkeypatch):
    """Return a function that writes the files of a command, of any contents, with the marks that it gives them."""

    def write(name, *options):
        checked = []

        def settle(targets, option="-o"):
            running = overwriting._running.get()
            running.prepare()
            checked.append(running)

        with monkeypatch.context() as patched:
            patched.setattr(files, "check_kept", settle)
            command(name, *options)
        moves = []
        for target in CASES[name][1]:
            temporary = files.Path(target).with_name(f"temporary_{files.Path(target).name}")
            temporary.write_bytes(b"contents \0\0\0\0IEND startxref ;")
            moves.append((temporary, files.Path(target)))
        for temporary, target in checked[-1].settle(moves):
            os.replace(temporary, target)

    return write


def change_mark(path, **values):
    mark = {**read_mark(path), **values}
    path.write_bytes(b"contents \0\0\0\0IEND startxref ;")
    write_mark(path, mark)


# Every third file: all commands write through one function.
@pytest.mark.parametrize(("name", "file"), FILES[::3])
def test_file_of_a_stranger_is_kept(name, file, folder):
    (folder / file).write_text("mine")
    assert_refused(command(name), f"{file} is kept, since ", "--overwrite", "-csv" if name == "echoes" else "-")
    assert (folder / file).read_text() == "mine"
    if file == CASES[name][1][0]:
        assert "is kept" not in command(name, "--overwrite").stderr


@pytest.mark.parametrize("name", [name for name in CASES if name not in ("echoes", "fly")][::3])
def test_files_of_the_same_command_and_scene_may_be_replaced(name, write_before, folder):
    """Not those of another command, scene or instrument, and those that took long."""
    write_before(name)
    done = command(name)
    assert done.exit_code == 2
    assert "is kept" not in done.stderr
    path = folder / next(file for file in CASES[name][1] if holds_mark(folder / file))
    mark, other = read_mark(path), CASES[name][2]
    if name in ("render", "view plot", "scenes water"):
        # All commands take these from the mark alone.
        change_mark(path, elapsed_s=75.0)
        assert_refused(command(name), "since it took 75 s to make", "--overwrite", "-")
        change_mark(path, **{**mark, "command": "another"})
        assert_refused(command(name), "since the command another has written it", "--overwrite", "-")
    if other:
        change_mark(path, **{**mark, "subject": {**mark["subject"], **other}})
        assert_refused(command(name), f"since its {next(iter(other)).replace('_', ' ')} is ", "--overwrite", "-o")


@pytest.mark.parametrize("name", ["tpu", "bounds", "figures", "fit"])
def test_table_that_was_edited_is_kept(name, write_before, folder):
    """The files beside it tell its SHA-256."""
    write_before(name)
    table = next(folder / file for file in CASES[name][1] if file.endswith(".csv"))
    table.write_text(table.read_text() + "edited")
    assert_refused(command(name), f"{table.name} is kept, since it does not tell what has written it")


def test_every_command_with_an_output_is_tested():
    with_output = {name for name in COMMANDS if "overwrite" in {one.name for one in MADE[name].params}}
    assert {words(name) for name in CASES} == with_output - {"scenes copy"}


def line(done):
    return [text for text in done.stderr.splitlines() if text.startswith("replaces ")]


@pytest.fixture
def small_figures(monkeypatch):
    """Draw empty figures for estimates, which takes a hundredth of the time."""
    from mitransient_lidar.plots import drawing, waveforms

    def draw(_, path):
        drawing.save(drawing.new_figure(path, 1, 1), path)

    monkeypatch.setattr(waveforms, "plot_components", draw)
    monkeypatch.setattr(overwriting, "_LONG_S", 1e9)  # on a busy machine


@pytest.mark.usefixtures("small_figures")
@pytest.mark.slow
def test_line_names_what_differs(folder):
    few = ["--depths", 2, "--passes", 2, "-o", "d/a.png"]
    first = ["scattering", "table1", *few]
    assert line(run(*first)) == []
    done = run(*first, "-D", "wind_speed=6", "--photons", 2048)
    assert line(done) == ["replaces d/a.nc and 1 more: wind_speed 3 -> 6, photons 65536 -> 2048"]
    assert_refused(run("scattering", "fig09_2x2", *few), "since its scene is table1")
    mounted = [*first, "--instrument", "riegl_vq840g"]
    assert_refused(run(*mounted), "since its instrument is another one")
    drawn = run("view", "--plot", "d/a.nc")
    assert_refused(drawn, "d/a.png is kept, since the command scattering has written it", "-o")
    done = run("scattering", "fig09_2x2", *few, "--overwrite")
    assert line(done) == ["replaces d/a.nc and 1 more: its scene is table1"]
    assert done.exit_code == 0
    # Files of one name in two folders are two scenes.
    for name in ("a", "b"):
        (folder / name).mkdir()
        run("scenes", "copy", "table1", f"{name}/lab.xml")
    few = ["scattering", *few[:-1], "d/f.png"]
    assert run(*few, "a/lab.xml").exit_code == 0
    assert_refused(run(*few, "b/lab.xml"), "since its scene file is ../a/lab.xml")
    assert run(*few, folder / "a/lab.xml").exit_code == 0


def test_result_of_an_earlier_release_counts_by_its_attributes(folder):
    """It has no mark, and the SHA-256 at its end."""
    held = {"scene": "table1", "pass_share": 1.0, "elapsed_s": 3.0, "scene.wind_speed": "5"}
    saved = results.open("shot.nc").assign_attrs(held)
    results.save(saved, "d/table1.nc")
    former = overwriting._mark_of_result(folder / "d/table1.nc")
    assert (former["command"], former["subject"]["scene"]) == ("render", "table1")
    assert "is kept" not in command("render").stderr
    results.save(saved.assign_attrs(elapsed_s=61.0), "d/table1.nc")
    assert_refused(command("render"), "since it took 61 s to make")
    results.save(saved.assign_attrs(scene="fig09_2x2"), "d/table1.nc")
    assert_refused(command("render"), "since its scene is fig09_2x2")
    saved.to_netcdf("d/table1.nc", engine="h5netcdf")
    assert_refused(command("render"), "since no command has written it as it is")


@pytest.mark.usefixtures("small_figures")
def test_file_made_meanwhile_keeps_its_name(folder, monkeypatch):
    """The new one gets another, so that no render is lost."""
    from mitransient_lidar.studies import light_classes

    found = light_classes.scattering

    @functools.wraps(found)
    def slow(*arguments, **options):
        (folder / "d/f.nc").write_text("mine")
        return found(*arguments, **options)

    stub(monkeypatch, "scattering", slow)
    done = run("scattering", "table1", "--depths", 2, "--passes", 2, "-o", "d/f.png")
    assert done.exit_code == 0
    assert "d/f.nc is kept, since no command has written it as it is: the new file is d/f_2.nc." in done.stderr
    assert (folder / "d/f.nc").read_text() == "mine"
    assert done.stdout.splitlines()[:2] == ["d/f.png", "d/f_2.nc"]


def test_flight_goes_on_in_its_own_folder(folder):
    """Beside the store, files whose headers name the software are those of the flight; `fly` checks the store."""
    las = b"LASF" + bytes(54) + b"mitransient-lidar 1.0"
    for name in ("points.laz", "waveforms.las", "waveforms.wdp"):
        (folder / "d" / name).write_bytes(las)
    assert_refused(command("fly"), "d/points.laz is kept, since it does not tell what has written it")
    (folder / "d/flight.zarr").mkdir()
    assert "is kept" not in command("fly").stderr
    (folder / "d/waveforms.las").write_bytes(b"LASF" + bytes(54) + b"another")
    assert_refused(command("fly"), "d/waveforms.las is kept", "--overwrite", "-o")


def test_store_of_a_stranger_is_kept(folder):
    campaign = 'scene = "table1"\n[parameters]\nbottom_depth = [2, 3]\n[design]\nkind = "grid"\n'
    (folder / "c.toml").write_text(campaign)
    (folder / "c.zarr").mkdir()
    (folder / "c.zarr/zarr.json").write_text("mine")
    for more in ([], ["--overwrite"]):
        assert_refused(run("campaign", "c.toml", *more, "-q"), "c.zarr is no store of a campaign or a flight")
    assert (folder / "c.zarr/zarr.json").read_text() == "mine"
