"""``squilla align``: bring the sub-images of any array to one view."""

import json
from pathlib import Path
from typing import Annotated

import typer

from squilla.errors import InputError


def align(
    stack: Annotated[Path, typer.Argument(help="Sub-images, (N, H, W): .npy or .tiff pages.")],
    shape: Annotated[str, typer.Option(help="Rows x columns of the array, such as 3x3 or 1x8.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Aligned: .npy or .tiff.")],
    reference: Annotated[int | None, typer.Option(help="Unit that stays where it is.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Align the sub-images of any array of lenses or cameras.

    They are cut out already, and stacked row by row.

    Example: squilla align views.tiff --shape 3x3 -o aligned.tiff
    """
    import numpy as np
    import tifffile

    from squilla.calibration.stack import agreement, align_stack
    from squilla.cli.checks import check_file
    from squilla.files.disk import existing, reading, replacing
    from squilla.files.tiff import read_pages

    try:
        rows, columns = (int(part) for part in shape.lower().split("x"))
    except ValueError as error:
        raise InputError(f"The shape is rows x columns, such as 3x3, not {shape!r}.") from error
    check_file(output, (".npy", ".tiff", ".tif"))
    path = existing(stack)
    with reading(path, "stack of sub-images"):
        npy = path.suffix.lower() == ".npy"
        images = np.load(path, mmap_mode="r") if npy else read_pages(path)
    aligned = align_stack(images, (rows, columns), reference=reference)
    pages = np.where(aligned.valid, aligned.y, np.nan).transpose(2, 0, 1).astype(np.float32)
    with replacing(output) as temporary, temporary.open("wb") as stream:
        if output.suffix.lower() == ".npy":
            np.save(stream, pages)
        else:
            tifffile.imwrite(stream, pages)
    facts = aligned.provenance
    left = float(np.median(agreement(aligned.y.numpy(), aligned.valid.numpy())))
    if as_json:
        typer.echo(json.dumps({"file": str(output), **facts, "left_unpredicted": left}))
        return
    typer.echo(
        f"{output}: neighbours lie {facts['disparity']:.3f} px apart (agreement "
        f"{facts['alignment_score']:.2f}); each view is predicted from the others but for "
        f"{100 * left:.1f} %"
    )
