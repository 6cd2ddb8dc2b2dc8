"""Compare the light of two states of the package, to the bit: a move within the code must keep it.

Run by hand, before a change and after it, with the same package versions, variant and machine::

    python tests/same_light.py store before       # results of all cases in a folder
    python tests/same_light.py compare before     # render again, and compare with them
    python tests/same_light.py compare before --only flights

Cases are all shipped scenes with both integrators (daylight with its own), all instruments over a default scene,
images, series of shots, derivatives, light by origin, a flight and a scene of Python.
Results differ in a case when a variable or a coordinate has other bits; a case also fails when attributes that state a
number differ. Where bits differ, the largest difference beside its standard error is printed.
"""

import mitransient_lidar  # noqa: I001

import argparse
import json
import sys
import tempfile
import time
import traceback
from pathlib import Path

import mitsuba as mi
import numpy as np
import xarray

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.catalogue import instrument_names
from mitransient_lidar.rendering.passive import render_passive

#: Attributes that may differ: of the machine, and those that hold whole scenes.
OTHER = {"elapsed_s", "created", "history", "scene_xml"}
#: Paths of a pass of each integrator.
PATHS = {"lidar_merging": 2**13, "lidar_volpath": 2**13}


def render(scene, integrator="lidar_merging", passes=2, **options):
    return mitransient_lidar.render(
        scene, integrator={"type": integrator, "paths_per_pass": PATHS[integrator]}, passes=passes, **options
    )


def solid_scene():
    """Return a scene of Python with instances, a mask, an own phase function, layers and waves, 3 km away."""
    aim = {"aim_x": 3000.0, "aim_y": -500.0}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "plastic"}}
    mask = {"type": "mask", "opacity": 0.6, "bsdf": {"type": "diffuse"}}

    def at(*place):
        return mi.ScalarAffineTransform4d().translate([aim["aim_x"] + place[0], aim["aim_y"] + place[1], place[2]])

    return {
        "tx": {"type": "lidar_transmitter", **aim},
        "rx": {"type": "multipixel_receiver", "layout": "1x4", "film": {"type": "time_gated_film"}, **aim},
        "sea": {
            "type": "ocean_surface",
            "interior": {
                "type": "layered_water",
                "layer_tops": "0, 2",
                "attenuation": "0.3, 0.4",
                "scattering": "0.2, 0.25",
                "backscattering": "0.004, 0.005",
            },
        },
        "bottom": {"type": "seabed", "curvature": -0.1, "refined_size": 4, "centre_x": 3000.0, "centre_y": -500.0},
        "balls": {"type": "shapegroup", "ball": ball},
        "one": {"type": "instance", "group": {"type": "ref", "id": "balls"}, "to_world": at(0.5, 0.2, -3.0)},
        "two": {"type": "instance", "group": {"type": "ref", "id": "balls"}, "to_world": at(-0.5, 0.0, -2.0)},
        "veil": {"type": "rectangle", "to_world": at(0.0, 0.4, -2.5), "bsdf": mask},
    }


def cases():
    """Return functions without arguments that return datasets, by name."""
    found = {}
    for name in catalogue.scene_names():
        given = catalogue.scene_parameters(name)
        small = {"layout": "16x16"} if name.startswith("gated") and "layout" in given else {}
        if name == "passive_sea":
            found[f"scenes/{name}"] = lambda: render_passive("passive_sea", passes=2)
            continue
        for kind in PATHS:
            found[f"scenes/{name}/{kind}"] = lambda n=name, k=kind, s=small: render(n, k, params=s)
    for name in instrument_names():
        found[f"instruments/{name}"] = lambda n=name: render("table1", instrument=n)
    for kind in PATHS:
        found[f"components/{kind}"] = lambda k=kind: render("fig13_2x2", k, components=True, batches=2)
    names = ["attenuation", "bottom_reflectance", "scattering", "wind_speed", "bottom_depth"]
    found["derivatives/merging"] = lambda: render("table1", derivatives=names)
    found["derivatives/volpath"] = lambda: render("fig02_mine", "lidar_volpath", derivatives=names[:3])
    found["python/merging"] = lambda: render(solid_scene())
    found["python/volpath"] = lambda: render(solid_scene(), "lidar_volpath")
    found["shots/moving"] = lambda: mitransient_lidar.render_shots(
        "table1", {"wind_speed": 5.0}, count=6, passes=4, derivatives=["attenuation"]
    )
    found["shots/mine"] = lambda: mitransient_lidar.render_shots(
        "fig13_2x2", count=6, passes=4, move_target=True, components=True
    )
    found["flights/strip"] = flight
    return found


def flight():
    """Return the points and the waveforms of a flight of few pulses."""
    plan = {
        "scene": "flight",
        "instrument": "published_airborne",
        "target_error": 0.3,
        "parameters": {"cube_size": 2, "cube_x": 3, "cube_depth": 5, "bottom_slope_x_deg": 2},
        "platform": {
            **{"kind": "lines", "start": [0.0, -2.0], "heading_deg": 90.0, "speed": 40.0, "height": 200.0},
            **{"duration_s": 0.1, "noise": {"roll_deg": 0.3, "pitch_deg": 0.3, "yaw_deg": 0.3, "correlation_s": 0.02}},
        },
        "scanner": {"kind": "palmer", "nadir_angle_deg": 20.0, "rate_hz": 10.0},
        "pulses": {"rate_hz": 160.0, "most": 16},
    }
    with tempfile.TemporaryDirectory() as folder:
        points = mitransient_lidar.fly(plan, Path(folder) / "flight", workers=1)
        return points.load()


def differences(old, new):
    said = []
    for name in sorted(set(old.variables) ^ set(new.variables)):
        said.append(f"{name} is only in the {'old' if name in old.variables else 'new'} one")
    for name in sorted(set(old.variables) & set(new.variables)):
        a, b = old[name].values, new[name].values
        if a.dtype != b.dtype or a.shape != b.shape:
            said.append(f"{name}: {a.dtype} {a.shape}, now {b.dtype} {b.shape}")
        elif a.tobytes() != b.tobytes():
            said.append(f"{name}: {apart(old, new, name)}")
    for name in sorted((set(old.attrs) | set(new.attrs)) - OTHER):
        a, b = old.attrs.get(name), new.attrs.get(name)
        if name == "plugin_parameters" and None not in (a, b):
            said += [f"plugin_parameters: {line}" for line in unlike(json.loads(a), json.loads(b))]
        elif str(np.asarray(a).tolist()) != str(np.asarray(b).tolist()):
            said.append(f"attribute {name}: {str(a)[:120]}, now {str(b)[:120]}")
    return said


def unlike(old, new, place=""):
    """Return sentences about values that differ in trees of dicts; the order of names does not count."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return [] if old == new else [f"{place}: {old!r}, now {new!r}"]
    names = sorted(set(old) | set(new))
    return [line for name in names for line in unlike(old.get(name), new.get(name), f"{place}.{name}")]


def apart(old, new, name):
    """Return how far the values of a variable lie apart, with standard errors where there are some."""
    a, b = old[name].values, new[name].values
    if a.dtype.kind not in "fiu":
        return "other values"
    with np.errstate(all="ignore"):
        said = f"sum {np.nansum(a):.6g}, now {np.nansum(b):.6g}, largest difference {np.nanmax(np.abs(a - b)):.3g}"
        error = old.get(f"{name}_standard_error", old.get(f"{name}_error"))
        if error is not None and error.shape == a.shape:
            z = (b - a) / np.hypot(error.values, error.values)
            said += f", {np.nanmax(np.abs(z[np.isfinite(z)]), initial=0):.2g} standard errors"
    return said


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["store", "compare", "list"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--only", default="", help="cases whose names contain this text")
    options = parser.parse_args()
    found = {name: case for name, case in cases().items() if options.only in name}
    failed = 0
    for name, case in found.items():
        path = None if options.folder is None else options.folder / f"{name.replace('/', '-')}.nc"
        if options.what == "list":
            print(name)
            continue
        start = time.monotonic()
        try:
            new = case()
            with tempfile.TemporaryDirectory() as folder:
                new.to_netcdf(Path(folder) / "case.nc")
                with xarray.open_dataset(Path(folder) / "case.nc", decode_times=False) as one:
                    new = one.load()
            if options.what == "store":
                path.parent.mkdir(parents=True, exist_ok=True)
                new.to_netcdf(path)
                said = []
            else:
                with xarray.open_dataset(path, decode_times=False) as old:
                    said = differences(old.load(), new)
        except Exception:
            said = [traceback.format_exc()]
        failed += bool(said)
        print(f"{'DIFFERS' if said else 'same'}  {name}  {time.monotonic() - start:.1f} s", flush=True)
        for line in said:
            print(f"    {line}", flush=True)
    if options.what != "list":
        print(f"{failed} of {len(found)} cases {'failed' if options.what == 'store' else 'differ'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
