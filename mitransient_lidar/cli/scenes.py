"""Commands about the shipped scenes and the system."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")]


def list_scenes() -> None:
    """List the shipped scenes."""
    from mitransient_lidar.loading import catalogue

    names = catalogue.scene_names()
    width = max(map(len, names), default=0)
    for name in names:
        typer.echo(f"{name:{width}}  {catalogue.scene_summary(name)}".rstrip())


def show_scene(name: Name) -> None:
    """Print the XML of a scene, self-contained."""
    from mitransient_lidar.loading.catalogue import scene_text

    typer.echo(scene_text(name), nl=False)


def copy_scene(
    name: Name,
    destination: Annotated[Path, typer.Argument(metavar="[DEST]", help="Folder, or path of the new file.")] = Path("."),
) -> None:
    """Copy a scene to a self-contained file to edit, and print its path. No file is overwritten."""
    from mitransient_lidar.loading import catalogue

    typer.echo(catalogue.copy_scene(name, destination))


def info(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="An EXR or NetCDF result.")] = None,
) -> None:
    """Print versions, the Mitsuba variant and the path of LLVM, or the parameters of a result.

    Of a result: its attributes, then every object of its scene with the values of all parameters, defaults too; a dash
    for those that are not given and have no default, or are not used.
    """
    if file is None:
        from mitransient_lidar.loading import variants

        facts = variants.describe()
    else:
        from mitransient_lidar.rendering.again import describe_result

        facts = describe_result(file)
    width = max(map(len, facts), default=0)
    for name, value in facts.items():
        typer.echo(f"{name:{width}}  {value}")


def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer cases, in less than a minute.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    case: Annotated[str | None, typer.Option(help="Run only this case.")] = None,
    target_error: Annotated[float | None, typer.Option(help="Relative standard error to reach.")] = None,
    images: Annotated[bool, typer.Option("--images", help="Time a gate of 4 to 65536 pixels to 10 % instead.")] = False,
) -> None:
    """Measure the time to a given accuracy."""
    from mitransient_lidar.studies import bench as benchmark
    from mitransient_lidar.studies import bench_images

    if images:
        bench_images.run(json=json)
    else:
        benchmark.run(quick=quick, json=json, case=case, target_error=target_error)
