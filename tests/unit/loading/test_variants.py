"""Finding LLVM and choosing a variant, with readable errors where neither works."""

import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest
from rows import must_refuse

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.studies.shots import find_shots


def test_the_wheels_llvm_is_found_through_its_metadata():
    path = variants.find_llvm()
    assert path is None or (path.is_file() and path.name.startswith("libLLVM.so."))


@pytest.mark.parametrize("name", ["libLLVM-15.so.1", "libLLVM.so.16.0", "libLLVM-14.so", "libLLVM.so.15"])
def test_llvm_releases_that_abort_are_refused_by_name(tmp_path, name):
    (tmp_path / name).touch()
    with pytest.raises(UserError, match=r"LLVM 1[456] .* install LLVM 17 or newer .*karellen-llvm-core"):
        variants.check_llvm_path(str(tmp_path / name))


def test_a_link_to_an_old_llvm_is_refused_too(tmp_path):
    (tmp_path / "libLLVM-15.so.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM-15.so.1")
    must_refuse("LLVM 15", variants.check_llvm_path, str(tmp_path / "libLLVM.so"))


def test_cuda_without_a_gpu_is_refused():
    if dr.has_backend(dr.JitBackend.CUDA):
        assert variants.set_variant("cuda_ad_mono") == "cuda_ad_mono"
    else:
        must_refuse("needs an NVIDIA GPU", variants.set_variant, "cuda_ad_mono")


def test_shots_leave_the_gpu_and_come_back(monkeypatch, caplog):
    """A kernel of OptiX traces rays through one Mitsuba scene: the bottom of a series had no light, without a word."""
    active = ["cuda_ad_mono"]

    def change(name=None):
        active.append(name or active[-1])
        return active[-1]

    monkeypatch.setattr(mi, "variant", lambda: active[-1])
    monkeypatch.setattr(mi, "set_variant", change)
    monkeypatch.setattr(variants, "set_variant", change)
    variants._tell_of_llvm.cache_clear()
    must_refuse("parameter", mitransient_lidar.render_shots, "table1", {"nonsense": 1}, positions=[(0, 0), (1, 1)])
    assert [active[number] for number in (1, 2, -1)] == ["cuda_ad_mono", "llvm_ad_mono", "cuda_ad_mono"]
    assert caplog.text.count("shots are rendered by llvm_ad_mono: a kernel of cuda_ad_mono") == 1


@pytest.mark.slow
def test_importing_without_a_usable_llvm_is_a_readable_error(tmp_path):
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(tmp_path / "missing.so")}
    done = subprocess.run(
        [sys.executable, "-c", "import mitransient_lidar"], env=environment, capture_output=True, text=True, check=False
    )
    if not dr.has_backend(dr.JitBackend.CUDA):
        assert done.returncode != 0
        assert "ImportError: DRJIT_LIBLLVM_PATH" in done.stderr
        assert "is not a file: install LLVM" in done.stderr


@pytest.mark.slow
def test_quick_kernels_are_others_with_the_same_bits_in_a_folder_of_their_own(tmp_path):
    """LLVM takes the options, without a word: the loop's kernel has another code."""
    loop = """
import mitransient_lidar
import drjit as dr
from drjit.llvm import Float
value, = dr.while_loop((dr.arange(Float, 64) / 7,), lambda x: x < 100, lambda x: (dr.sin(x) + 1.5 * x + 1,))
print(value.numpy().tobytes().hex())
"""
    kernels, bits = [], []
    for folder, variable in ((".drjit", ""), (".drjit/quick", "1")):
        environment = {**os.environ, "HOME": str(tmp_path), "MITRANSIENT_LIDAR_QUICK_KERNELS": variable}
        environment.pop("DRJIT_CACHE_DIR", None)
        done = subprocess.run([sys.executable, "-c", loop], env=environment, capture_output=True, text=True, check=True)
        assert done.stderr == ""
        bits.append(done.stdout)
        kernels.append({file.name: file.read_bytes() for file in (tmp_path / folder).glob("*.bin")})
    assert bits[0] == bits[1]
    assert kernels[0].keys() == kernels[1].keys()
    assert variants.find_llvm() is None or kernels[0] != kernels[1]


@pytest.fixture
def rgb():
    ours = mi.variant()
    mi.set_variant("scalar_rgb")
    yield "scalar_rgb"
    mi.set_variant(ours)


def test_plugins_name_the_variants_that_they_need(rgb):
    """In place of ``Plugin "petzold" not found!`` each refuses by a sentence; coming back they work again."""
    sources = "".join(path.read_text() for path in Path(variants.__file__).parents[2].glob("plugins/**/*.py"))
    for name, (_, kind) in variants.PLUGIN_MODULES.items():
        assert f'register("{kind}", {name.upper()}' in sources
        with pytest.raises(RuntimeError, match=f"UserError: {name} needs the variant llvm_ad_mono or .* scalar_rgb is"):
            mi.load_dict({"type": name})
    mi.set_variant(variants.set_variant())
    assert mi.load_dict({"type": "petzold"}).backscatter_ratio > 0


def test_functions_leave_the_variant_as_they_found_it(rgb):
    """Also by an error; only what loads a scene for later leaves that of the scene."""
    must_refuse("nonsense", mitransient_lidar.render, "table1", params={"nonsense": 1})
    assert mi.variant() == rgb
    assert find_shots("fig09_2x2", {"surface_cell_size": 1}, waveforms=False).shots
    assert mi.variant() == rgb
    open_scene("table1", {"spectrum": "flat"})
    assert mi.variant() in variants.SUPPORTED_VARIANTS


def test_scenes_are_loaded_by_two_threads_at_least(monkeypatch):
    """With one, as in the processes of campaigns, Mitsuba waits for ever where a texture is an EXR file."""
    counts, instantiate = [], mi.parser.instantiate

    def counted(*args):
        counts.append(dr.thread_count())
        return instantiate(*args)

    monkeypatch.setattr(mi.parser, "instantiate", counted)
    before = dr.thread_count()
    try:
        for count in (1, 3):
            dr.set_thread_count(count)
            open_scene("table1")
            assert dr.thread_count() == count
    finally:
        dr.set_thread_count(before)
    assert counts == [2, 3]
