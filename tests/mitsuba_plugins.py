"""All plugins of the installed Mitsuba in lidar scenes: which work, which are refused, and which are ignored.

``python tests/mitsuba_plugins.py --passes 40`` renders every one that works with both integrators and writes the table
of ``docs/guide/mitsuba_scenes.md`` again. `tests/system/test_mitsuba_plugins.py` does so with few passes.
"""

import mitransient_lidar  # noqa: I001

import argparse
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.variants import set_variant
from mitransient_lidar.loading.scenes import choose_integrator, open_scene

PAGE = Path(__file__).parent.parent / "docs" / "guide" / "mitsuba_scenes.md"
#: Paths of a pass, and passes of the reference for one of the fast integrator.
PATHS, MORE = {"lidar_merging": 2**15, "lidar_volpath": 2**16}, 2
#: Kinds of plugins, in the order of the page.
KINDS = (
    *("Shape", "BSDF", "Texture", "Volume", "PhaseFunction", "Medium", "Emitter", "Sensor", "Film", "Sampler"),
    *("ReconstructionFilter", "Integrator"),
)
GREY = {"type": "diffuse", "reflectance": 0.5}
BASE = {"type": "bitmap", "raw": True}
#: A camera above the sea.
LOOK = {"origin": [0, -9, 9], "target": [0, 0, 0], "up": [0, 0, 1]}
_NUMBERS = np.random.default_rng(1).uniform(0.2, 0.8, (4, 4, 4, 3)).astype(np.float32)


@cache
def installed():
    """Return the kind of each plugin of the installed Mitsuba by its name, those in Python among them."""
    folder, found = Path(mi.__file__).parent, {}
    for path in (folder / "plugins").glob("*.so"):
        node = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), {"type": path.stem}).nodes[0]
        found[path.stem] = str(node.type).removeprefix("ObjectType.")
    names = {kind.lower(): kind for kind in KINDS} | {"phase": "PhaseFunction", "texture": "Texture"}
    for path in (folder / "python").rglob("*.py"):
        for kind, name in re.findall(r"\bregister_(\w+)\(\s*['\"](\w+)['\"]", path.read_text("utf-8")):
            found[name] = names[kind]
    return found


@dataclass(frozen=True)
class Group:
    """A scene in which plugins work.

    Attributes
    ----------
    scene
        Description of the scene.
    plugins
        What each plugin is in it, by name.
    origin
        Origin of the light that shows the plugin; `{}` is its name.
    factor
        Paths for one of another group.
    """

    scene: dict
    plugins: dict[str, str]
    origin: str = "{}"
    factor: int = 1


@dataclass(frozen=True)
class Row:
    """Plugin, verdict, what it is tried as or why it is refused, and energies by the fast integrator and reference."""

    plugin: str
    verdict: str
    told: str
    passes: tuple[np.ndarray, np.ndarray] | None = None

    def ratio(self):
        (a, da), (b, db) = ((one.mean(), one.std(ddof=1) / len(one) ** 0.5) for one in self.passes)
        return a / b, a / b * np.hypot(da / a, db / b)


def base(**parts):
    """Return a scene of 6 m of water below a lidar at 50 m, with parts."""
    lidar = {"altitude": 50.0, "off_nadir_deg": 0.0}
    film = {"type": "time_gated_film"}
    water = {"attenuation": 0.2, "scattering": 0.1, "backscattering": 0.003}
    return {
        "tx": {"type": "lidar_transmitter", "divergence_mrad": 60.0, **lidar},
        "rx": {"type": "multipixel_receiver", "layout": "1x1", "field_of_view_mrad": 120.0, "film": film, **lidar},
        "sea": {"type": "ocean_surface", "spectrum": "flat", "interior": {"type": "layered_water", **water}},
        "bottom": {"type": "seabed", "depth": 6.0},
        **parts,
    }


def placed(size, *place, turn=0.0):
    return mi.ScalarTransform4f().translate(list(place)).rotate([1, 0, 0], turn).scale(size)


def places(count):
    """Return places of solids in the beam, about the middle [m]."""
    side = int(np.ceil(count**0.5))
    return [
        (1.1 * (number % side - (side - 1) / 2), 1.1 * (number // side - (side - 1) / 2)) for number in range(count)
    ]


def texture(width=3):
    return {**BASE, "data": mi.TensorXf(_NUMBERS[0, ..., :width])}


def shapes(folder):
    """Return a target of each shape; groups and instances show each other."""
    cube = mi.load_dict({"type": "cube"})
    cube.write_ply(str(folder / "cube.ply"))
    (folder / "square.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n")
    bends = np.linspace(0, 5, 8)
    np.savetxt(folder / "curve.txt", np.transpose([np.sin(bends), np.cos(bends), 0.1 * bends, np.full(8, 0.25)]))
    ball = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 17)] * 3)), axis=0) - 0.9
    own = {
        **{name: {} for name in ("sphere", "cube", "disk", "rectangle", "cylinder")},
        "obj": {"filename": str(folder / "square.obj")},
        "ply": {"filename": str(folder / "cube.ply")},
        "bsplinecurve": {"filename": str(folder / "curve.txt")},
        "linearcurve": {"filename": str(folder / "curve.txt")},
        "sdfgrid": {"grid": mi.TensorXf(ball[..., None].astype(np.float32))},
        "ellipsoids": {},
        "ellipsoidsmesh": {},
        "merge": {},
        "instance": {"group": {"type": "ref", "id": "shapegroup"}},
    }
    solids = {"shapegroup": {"type": "shapegroup", "member": {"type": "sphere", "bsdf": GREY}}}
    for (name, values), (x, y) in zip(own.items(), places(len(own)), strict=True):
        to_world = placed(0.4, x, y, -2, turn=90.0 if name == "cylinder" else 0.0)
        if name == "sdfgrid":
            to_world = placed(0.8, x - 0.4, y - 0.4, -2.4)
        part = {"type": name, "bsdf": GREY, **values}
        if name == "merge":
            part = {"type": name, "part": {"type": "cube", "bsdf": GREY, "to_world": to_world}}
        elif "ellipsoid" in name:
            given = {"centers": [[x, y, -2]], "scales": [[0.15, 0.12, 0.1]], "quaternions": [[0, 0, 0, 1]]}
            part |= {key: mi.TensorXf(np.array(numbers, np.float32)) for key, numbers in given.items()}
        else:
            part["to_world"] = to_world
        if name == "instance":
            part.pop("bsdf")
        solids[name] = part
    told = dict.fromkeys(own, "target") | {"merge": "its parts, one by one, as targets"}
    told["ellipsoids"] = told["ellipsoidsmesh"] = "target; the scene stays where it is, far from the origin as well"
    scene = base(**solids)
    return [Group(scene, told), Group(scene, {"shapegroup": "what an instance repeats"}, "instance")]


def bsdfs(_):
    """Return a plate of each BSDF; those with glints, which few paths find, in a scene of their own."""
    cracks = {"type": "checkerboard", "to_uv": mi.ScalarTransform3d().scale([3, 3])}
    own = {
        "blendbsdf": {"weight": 0.3, "first": {"type": "diffuse", "reflectance": 0.2}, "second": GREY},
        "bumpmap": {"texture": texture(1), "scale": 0.1, "nested": GREY},
        "diffuse": {"reflectance": 0.5},
        "mask": {"opacity": cracks, "nested": GREY},
        "normalmap": {"normalmap": texture(), "nested": GREY},
        "pplastic": {"alpha": 0.3},
        "principled": {"base_color": 0.5, "roughness": 0.4},
        "principledthin": {"base_color": 0.5, "roughness": 0.4},
        "roughconductor": {"alpha": 0.3},
        "roughplastic": {"alpha": 0.3},
        "twosided": {"nested": GREY},
    }
    # Half of the light is reflected, so that few paths show it.
    glass = {"int_ior": 8.0, "ext_ior": 1.34}
    glints = {
        "conductor": {"specular_reflectance": 0.5},
        "dielectric": glass,
        "plastic": {**glass, "diffuse_reflectance": 0.5},
        "roughdielectric": {**glass, "alpha": 0.1},
        "thindielectric": glass,
    }
    plates, mirrors = (
        base(
            **{
                name: {"type": "rectangle", "to_world": placed(0.5, x, y, -2), "bsdf": {"type": name, **values}}
                for (name, values), (x, y) in zip(part.items(), places(len(part)), strict=True)
            }
        )
        for part in (own, glints)
    )
    veil = base(null={"type": "rectangle", "to_world": placed(2.0, 0, 0, -2), "bsdf": {"type": "null"}})
    told = "a solid without effect, which is left out; light of the bottom below it"
    return [
        Group(plates, dict.fromkeys(own, "plate")),
        Group(mirrors, dict.fromkeys(glints, "plate, mostly its reflection"), factor=3),
        Group(veil, {"null": told}, "bottom"),
    ]


def textures(folder):
    square = mi.Mesh("square", 4, 2)
    values = mi.traverse(square)
    values["vertex_positions"] = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]
    values["faces"] = [0, 1, 2, 0, 2, 3]
    values.update()
    square.add_attribute("vertex_grey", 1, [0.2, 0.4, 0.8, 0.6])
    square.write_ply(str(folder / "grey.ply"))
    tiles = mi.ScalarTransform3d().scale([3, 3])
    grid = {"type": "gridvolume", "data": mi.TensorXf(_NUMBERS[..., :1]), "raw": True}
    own = {
        "bitmap": texture(1),
        "checkerboard": {"type": "checkerboard", "to_uv": tiles},
        "mesh_attribute": {"type": "mesh_attribute", "name": "vertex_grey"},
        "rawconstant": {"type": "rawconstant", "value": 0.5},
        "srgb": {"type": "srgb", "color": [0.2, 0.5, 0.4]},
        "uniform": {"type": "uniform", "value": 0.5},
        "gridvolume": grid,
        "constvolume": {"type": "constvolume", "value": 0.5},
    }
    plates = {}
    for (name, one), (x, y) in zip(own.items(), places(len(own)), strict=True):
        to_world = placed(0.5, x, y, -2)
        if name == "gridvolume":
            one["to_world"] = placed(1.0, x - 0.5, y - 0.5, -2.5)
        given = {"type": "volume", "volume": one} if "volume" in name else one
        shape = {"type": "ply", "filename": str(folder / "grey.ply")} if name == "mesh_attribute" else {}
        bsdf = {"type": "diffuse", "reflectance": given}
        plates[name] = {"type": "rectangle", "to_world": to_world, "bsdf": bsdf, **shape}
    told = dict.fromkeys(own, "reflectance of a plate")
    told["srgb"] = "reflectance of a plate: the luminance of the colour"
    told["gridvolume"] = told["constvolume"] = "in the texture `volume`, reflectance of a plate"
    scene = base(**plates)
    return [Group(scene, told), Group(scene, {"volume": "reflectance of a plate, by a `gridvolume`"}, "gridvolume")]


def phase_functions(_):
    own = {
        "hg": {"g": 0.8},
        "isotropic": {},
        "rayleigh": {},
        "blendphase": {"weight": 0.3, "first": {"type": "hg", "g": 0.8}, "second": {"type": "rayleigh"}},
        "tabphase": {"values": "0.5, 1, 1.5, 2"},
    }
    groups = []
    for name, values in own.items():
        scene = base()
        scene["sea"]["interior"]["phase_0"] = {"type": name, **values}
        groups.append(Group(scene, {name: "phase function of the water; light of the water"}, "water"))
    return groups


#: Builders of scenes in which plugins work, of a folder for files.
GROUPS: tuple[Callable[[Path], list[Group]], ...] = (shapes, bsdfs, textures, phase_functions)


def camera(film=None, **values):
    return {"type": "perspective", "film": film or {"type": "hdrfilm", "width": 8, "height": 8}, **values}


def ignored():
    """Return parts of a scene for a picture, which lidar integrators leave alone, by plugin."""
    to_world = mi.ScalarTransform4f().look_at(**LOOK)
    dot = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "disk", "to_world": placed(0.1, 5, 5, 9)}
    kinds = ("independent", "ldsampler", "multijitter", "orthogonal", "stratified")
    filters = ("box", "catmullrom", "gaussian", "lanczos", "mitchell", "tent")
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    return {
        "perspective": camera(to_world=to_world),
        "thinlens": camera(to_world=to_world, aperture_radius=0.1) | {"type": "thinlens"},
        "orthographic": camera(to_world=to_world) | {"type": "orthographic"},
        "radiancemeter": camera(dot, to_world=to_world) | {"type": "radiancemeter"},
        "distant": camera(dot, direction=[0, 0, -1]) | {"type": "distant"},
        "batch": camera(first=camera(), second=camera()) | {"type": "batch"},
        "irradiancemeter": {**meter, "sensor": {"type": "irradiancemeter", "film": dot}},
        "flat_sensor": {**meter, "to_world": placed(0.1, -5, 5, 9), "sensor": camera() | {"type": "flat_sensor"}},
        "hdrfilm": camera(to_world=to_world),
        **{name: camera(to_world=to_world, sampler={"type": name, "sample_count": 16}) for name in kinds},
        **{name: camera({**film, "rfilter": {"type": name}}, to_world=to_world) for name in filters},
    }


def energies(scene, integrator, passes, share):
    """Return energies of passes by origin [J], shape (passes,) each, of a share of the paths."""
    session = open_scene(scene)
    renderer = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor).by_origin()
    rows = []
    for seed in range(passes):
        energy = renderer.render_pass(seed, paths=int(share * PATHS[integrator])).histogram.energy()
        rows.append(energy.reshape(-1, renderer.classes.count, energy.shape[-1]).sum(axis=(0, 2)))
    return dict(zip(renderer.classes.names, np.transpose(rows), strict=True))


def working(groups, passes, share=1.0):
    """Yield the rows of the plugins of groups, which work, from passes of a share of the paths."""
    found = {}
    for group in groups:
        key = id(group.scene)
        if key not in found:
            counts = {"lidar_merging": passes, "lidar_volpath": MORE * passes}
            found[key] = [energies(group.scene, name, count, share * group.factor) for name, count in counts.items()]
        for plugin, told in group.plugins.items():
            yield Row(plugin, "works", told, tuple(one[group.origin.format(plugin)] for one in found[key]))


def beside():
    """Return the rows of plugins that are ignored, after a look at the bits of a scene with and without them."""
    from same_bits import assert_same_bits

    parts = ignored()
    meters = {name: part for name, part in parts.items() if "sensor" in part}
    bare = {name: {key: value for key, value in part.items() if key != "sensor"} for name, part in meters.items()}
    results = []
    for extra in (bare, parts):
        engine = {"type": "lidar_volpath", "paths_per_pass": 2**12}
        results.append(mitransient_lidar.render(base(**extra), integrator=engine, passes=2))
    assert_same_bits(*results)
    told = {name: "of a camera" if installed()[name] != "Sensor" else "beside the receiver" for name in parts}
    told |= dict.fromkeys(meters, "beside the receiver; the shape that carries it is a solid as others")
    return [Row(name, "ignored", told[name]) for name in parts]


def refused(plugin, kind):
    """Return the row of a plugin with which a scene is refused, None if it is not."""
    part = {"type": plugin}
    parts = {
        "BSDF": {"solid": {"type": "sphere", "bsdf": part}},
        "Texture": {"solid": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": part}}},
        "Film": {"camera": camera(part)},
        "Integrator": {"integrator": part},
    }.get(kind, {"part": part})
    if kind == "PhaseFunction":
        stretched = mi.VolumeGrid(np.tile(np.float32([1, 1, 0.5, 0, 0, 0]), (2, 2, 2, 1)))
        parts = base()
        parts["sea"]["interior"]["phase_0"] = part | {"S": {"type": "gridvolume", "grid": stretched}}
    if plugin in ("aov", "moment", "stokes"):
        part |= {"aovs": "depth:depth"} if plugin == "aov" else {"nested": {"type": "path"}}
    try:
        session = open_scene(base(**parts))
        choose_integrator(session.scene, None if kind == "Integrator" else "lidar_volpath")
    except UserError as error:
        return Row(plugin, "refused", str(error))
    return None


def rows(passes, wanted=()):
    """Return the rows of all plugins by name; with `wanted`, of those that work in scenes with one of these."""
    with tempfile.TemporaryDirectory() as folder:
        groups = [group for builder in GROUPS for group in builder(Path(folder))]
        groups = [group for group in groups if not wanted or set(wanted) & group.plugins.keys()]
        found = {row.plugin: row for row in working(groups, passes)}
    if wanted:
        return found
    found |= {row.plugin: row for row in beside()}
    for plugin, kind in installed().items():
        if plugin not in found and (row := refused(plugin, kind)):
            found[plugin] = row
    return found


def table(found):
    lines = []
    for kind in KINDS:
        heading = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", kind)
        heading = heading if kind == "BSDF" else heading.capitalize()
        lines += [
            f"### {heading}",
            "",
            "| plugin | verdict | tried as, or why | fast / reference |",
            "|---|---|---|---|",
        ]
        for plugin in sorted(name for name, own in installed().items() if own == kind):
            row = found[plugin]
            figure = "" if row.passes is None else "{:.3f} ± {:.3f}".format(*row.ratio())
            lines.append(f"| `{plugin}` | {row.verdict} | {row.told.replace('|', '/')} | {figure} |")
        lines.append("")
    return "\n".join(lines)


def read_page():
    """Return verdict, sentence and figures of each plugin on the page."""
    text = PAGE.read_text("utf-8")
    return {name: others for name, *others in re.findall(r"^\| `(\w+)` \| (\w+) \| (.*) \| (.*) \|$", text, re.M)}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--passes", type=int, default=40, help="passes of the fast integrator")
    parser.add_argument("plugins", nargs="*", help="print the ratio of these alone")
    options = parser.parse_args()
    set_variant()
    if options.plugins:
        for row in rows(options.passes, options.plugins).values():
            print(row.plugin, "{:.4f} +- {:.4f}".format(*row.ratio()), flush=True)
        return
    found = rows(options.passes)
    text = PAGE.read_text("utf-8")
    start = text.index("### Shape")
    PAGE.write_text(text[:start] + table(found), "utf-8")
    verdicts = [row.verdict for row in found.values()]
    print({verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))})


if __name__ == "__main__":
    main()
