"""`intabs hand`: key points of a hand, in pictures, in space, on the bus."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError, as_user_error
from intabs.output import Progress, write_json

DEFAULT_LCM = "udpm://239.255.76.67:7667?ttl=0"


class Method(StrEnum):
    robust = "robust"
    gaussian = "gaussian"


def register(app: typer.Typer) -> None:
    @app.command()
    def hand(
        source: Annotated[
            str,
            typer.Argument(help="Folder of pictures (NAME_o.jpg with NAME_depth.png), or KIND:WHERE with --publish."),
        ],
        out: Annotated[
            Path | None, typer.Option(help="NPZ file: time, uv, score, and with depth points, state.")
        ] = None,
        method: Annotated[
            Method, typer.Option(help="Depth at a key point: median near the palm's, or the thesis' weighted mean.")
        ] = Method.robust,
        intrinsics: Annotated[Path | None, typer.Option(help="fx fy cx cy; otherwise *intrinsics.txt there.")] = None,
        independent: Annotated[
            bool, typer.Option("--independent", help="The pictures have nothing to do with each other.")
        ] = False,
        background: Annotated[
            int, typer.Option(help="Put a wall so many mm behind the hand where there is no depth.", min=0, max=5000)
        ] = 0,
        publish: Annotated[
            bool, typer.Option("--publish", help="Send every hand found as HAND_KEYPOINTS_<camera>.")
        ] = False,
        camera: Annotated[str, typer.Option(help="Name of the camera, in the channel and in a ring.")] = "left",
        lcm: Annotated[str, typer.Option(help="LCM URL.")] = DEFAULT_LCM,
        frames: Annotated[int, typer.Option(help="Stop after so many frames; 0: at the end.", min=0)] = 0,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Find a hand's 21 key points with MediaPipe; with depth, filter them into points in space.

        KIND:WHERE is ring:/NAME, v4l2:DEVICE, realsense:SERIAL, folder:DIR or video:FILE. Points are in the camera's
        frame. Where joints are labelled (NAME_Joint.obj), the distance to them is measured.
        """
        from intabs.hand import offline, producer

        if publish or not Path(source).is_dir():
            if not publish:
                if ":" not in source:
                    raise UserError(f"{source}: no such folder")
                raise UserError(f"{source} can only be published: add --publish")
            if out is not None:
                raise UserError("--out is for folders without --publish: record the channel with intabs_record")
            spec = source if ":" in source else f"folder:{source}"
            with as_user_error(RuntimeError):
                figures = producer.publish(spec, camera, lcm, independent, frames)
            write_json(json, figures)
            print(f"{figures['frames']} frames, a hand in {figures['found']}, {figures['ms']['p50']:.1f} ms each")
            return
        options = offline.Options(method.value, independent, background, intrinsics, frames)
        with Progress("hand", total=1.0) as progress, as_user_error(ValueError):
            figures = offline.process_folder(Path(source), out, options, progress.update)
        write_json(json, figures)
        print(offline.describe(figures))
        if out is not None:
            print(f"wrote {out}")
