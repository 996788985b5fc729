"""Demonstrations to look at: one HTML page that needs nothing else, a picture strip, or rerun or viser if installed."""

from __future__ import annotations

import base64
import html
import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs.data.demos import Demo, name_list
from intabs.data.reader import DemoFile, inspect
from intabs.data.resample import xyzw
from intabs.errors import UserError

POINTS = 400  # of a curve
PICTURES = 60  # of a demonstration, in the page
COLOURS = ["#0b6fa4", "#d1495b", "#2e8b57", "#b8860b", "#6a4c93", "#00798c", "#8d5524", "#555555"]
WIDTH, HEIGHT, LEFT = 640, 110, 46


@dataclass
class Chart:
    title: str
    unit: str
    curves: dict[str, np.ndarray]  # name -> (T,), nan where there is nothing to see


def charts(demo: Demo, fields: tuple[str, ...]) -> list[Chart]:
    obs = demo.observations()
    out = []
    for name in dict.fromkeys([*fields, "robot_joint_vel", "robot_gripper"]):
        if name not in obs:
            continue
        value = np.asarray(obs[name], float).reshape(len(demo), -1)
        unit = {"robot_joint_pos": "rad", "robot_joint_vel": "rad/s", "robot_gripper": "closed"}.get(name, "")
        names = name_list(demo.attrs.get("joint_names")) if name.startswith("robot_joint") else []
        names = names if len(names) == value.shape[1] else [str(i + 1) for i in range(value.shape[1])]
        out.append(Chart(name, unit, dict(zip(names, value.T, strict=True))))
    names = name_list(demo.attrs.get("object_names"))
    for i in range(demo.object_pose.shape[1]):
        valid = demo.object_valid[:, i].astype(bool)
        if not valid.any():
            continue
        seen = np.where(valid[:, None], demo.object_pose[:, i], np.nan)
        name = f"object {i}" + (f" ({names[i]})" if i < len(names) else "")
        out.append(Chart(f"{name}: position", "m", dict(zip("xyz", seen[:, :3].T, strict=True))))
        out.append(Chart(f"{name}: orientation", "", dict(zip("wxyz", seen[:, 3:].T, strict=True))))
    if "object_joint_pos" in obs:
        value = obs["object_joint_pos"].reshape(len(demo), -1)
        names = name_list(demo.attrs.get("object_joint_names"))
        names = names if len(names) == value.shape[1] else [str(i + 1) for i in range(value.shape[1])]
        out.append(Chart("object_joint_pos", "rad, m", dict(zip(names, value.T, strict=True))))
    return out


def _thin(time: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """No more than POINTS, the extremes kept."""
    if len(y) <= POINTS:
        return time, y
    parts = np.array_split(np.arange(len(y)), POINTS // 2)
    safe = np.nan_to_num(y)
    pick = sorted({int(p[i]) for p in parts for i in (np.argmin(safe[p]), np.argmax(safe[p]))})
    return time[pick], y[pick]


def _scale(chart: Chart) -> tuple[float, float]:
    values = np.concatenate([np.asarray(y, float) for y in chart.curves.values()])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    return (low, high) if high - low > 1e-9 else (low - 0.5, high + 0.5)


def _svg(chart: Chart, time: np.ndarray) -> str:
    low, high = _scale(chart)
    span = max(float(time[-1] - time[0]), 1e-9)
    lines = []
    for i, (name, y) in enumerate(chart.curves.items()):
        t, v = _thin(time, np.asarray(y, float))
        x = LEFT + (t - time[0]) / span * (WIDTH - LEFT - 4)
        h = HEIGHT - 6 - (v - low) / (high - low) * (HEIGHT - 12)
        path, pen = [], "M"
        for a, b in zip(x, h, strict=True):
            if np.isfinite(b):
                path.append(f"{pen}{a:.1f} {b:.1f}")
                pen = "L"
            else:
                pen = "M"
        lines.append(
            f'<path d="{"".join(path)}" stroke="{COLOURS[i % len(COLOURS)]}"><title>{html.escape(name)}</title></path>'
        )
    legend = " ".join(
        f'<tspan fill="{COLOURS[i % len(COLOURS)]}">{html.escape(n)}</tspan>'
        for i, n in enumerate(list(chart.curves)[:12])
    )
    title = html.escape(chart.title + (f" [{chart.unit}]" if chart.unit else ""))
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT + 16}"><text x="{LEFT}" y="11">{title} {legend}</text>'
        f'<g transform="translate(0 16)"><rect x="{LEFT}" y="0" width="{WIDTH - LEFT - 4}" height="{HEIGHT}"/>'
        f'<text x="{LEFT - 4}" y="12" text-anchor="end">{high:.3g}</text>'
        f'<text x="{LEFT - 4}" y="{HEIGHT - 2}" text-anchor="end">{low:.3g}</text>{"".join(lines)}'
        f'<line class="now" x1="{LEFT}" x2="{LEFT}" y1="0" y2="{HEIGHT}"/></g></svg>'
    )


def _from_above(demo: Demo) -> str:
    """Paths of the objects, x to the right, y up."""
    seen = [demo.object_pose[demo.object_valid[:, i].astype(bool), i, :2] for i in range(demo.object_pose.shape[1])]
    points = [p for p in seen if len(p)]
    if not points:
        return ""
    every = np.concatenate(points)
    middle, half = (every.min(0) + every.max(0)) / 2, max(float(np.ptp(every, axis=0).max()) / 2, 0.02) * 1.1
    size = 220
    lines = []
    for i, p in enumerate(seen):
        if not len(p):
            continue
        p = p[np.linspace(0, len(p) - 1, min(len(p), POINTS)).astype(int)]
        xy = (p - middle) / half * size / 2 + size / 2
        xy[:, 1] = size - xy[:, 1]
        colour = COLOURS[i % len(COLOURS)]
        path = "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in xy)
        lines.append(f'<path d="{path}" stroke="{colour}"/><circle cx="{xy[0, 0]:.1f}" cy="{xy[0, 1]:.1f}" r="3" '
                     f'fill="{colour}"><title>object {i}, start</title></circle>')  # fmt: skip
    return (
        f'<svg class="above" viewBox="0 0 {size} {size + 16}">'
        f'<text x="2" y="11">from above, {2 * half:.2g} m wide</text>'
        f'<g transform="translate(0 16)"><rect width="{size}" height="{size}"/>{"".join(lines)}</g></svg>'
    )


def _bands(demo: Demo, names: list[str]) -> str:
    """The labels as coloured bands."""
    labels = demo.extra.get("labels")
    if labels is None or labels.ndim != 1 or not len(labels):
        return ""
    edges = np.flatnonzero(np.diff(labels, prepend=-1))
    stop = np.append(edges[1:], len(labels))
    parts = []
    for a, b in zip(edges, stop, strict=True):
        k = int(labels[a])
        name = html.escape(names[k] if k < len(names) else str(k))
        x = LEFT + a / len(labels) * (WIDTH - LEFT - 4)
        w = (b - a) / len(labels) * (WIDTH - LEFT - 4)
        parts.append(f'<rect class="band" x="{x:.1f}" width="{w:.1f}" y="16" height="18" fill="{COLOURS[k % 8]}">'
                     f'<title>{name}: frames {a}-{b - 1}</title></rect>')  # fmt: skip
        if w > 5 * len(name):
            parts.append(f'<text x="{x + w / 2:.1f}" y="29" text-anchor="middle" class="on">{name}</text>')
    return f'<svg viewBox="0 0 {WIDTH} 38"><text x="{LEFT}" y="11">labels</text>{"".join(parts)}</svg>'


def pictures(demo: Demo, count: int) -> list[tuple[int, str]]:
    """(frame, JPEG as base64) of the first camera in the observations: (T, h, w, 3) bytes."""
    from PIL import Image

    for value in demo.obs.values():
        if value.ndim == 4 and value.shape[3] == 3 and value.dtype == np.uint8:
            out = []
            for k in np.unique(np.linspace(0, len(value) - 1, min(count, len(value))).astype(int)):
                image = Image.fromarray(value[k])
                image.thumbnail((320, 320))
                buffer = io.BytesIO()
                image.save(buffer, "JPEG", quality=80)
                out.append((int(k), base64.b64encode(buffer.getvalue()).decode()))
            return out
    return []


STYLE = """
body{font:14px system-ui,sans-serif;margin:1.5em auto;max-width:1000px;color:#222;padding:0 1em}
section{border-top:1px solid #ccc;padding:.6em 0;display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start}
section h2{flex-basis:100%;font-size:1.05em;margin:.2em 0}.charts{flex:1 1 620px;min-width:300px}
aside{flex:0 0 240px}svg{width:100%;display:block;margin-bottom:4px}svg text{font-size:10px;fill:#444}
svg path{fill:none;stroke-width:1.2}svg rect{fill:#fafafa;stroke:#ddd}svg .now{stroke:#000;stroke-dasharray:2 2}
svg rect.band{fill-opacity:.55;stroke:none}svg text.on{fill:#000}
img{width:100%}input{width:100%}table{border-collapse:collapse}td{padding:0 1em 0 0;vertical-align:top}
"""
SCRIPT = """
document.querySelectorAll('section').forEach(s=>{
 const bar=s.querySelector('input'),say=s.querySelector('output'),img=s.querySelector('img');
 const shots=JSON.parse(s.querySelector('script').textContent);
 const show=()=>{const f=bar.value/Math.max(bar.max,1),x=LEFT+f*SPAN;
  s.querySelectorAll('.now').forEach(l=>{l.setAttribute('x1',x);l.setAttribute('x2',x)});
  say.textContent='frame '+bar.value+', '+(f*bar.dataset.seconds).toFixed(2)+' s';
  if(img){let best=shots[0];for(const p of shots)if(p[0]<=bar.value)best=p;img.src='data:image/jpeg;base64,'+best[1]}};
 bar.addEventListener('input',show);show()});
"""


def page(path: Path, chosen: list[int]) -> str:
    """HTML without anything from elsewhere."""
    figures = inspect(path)
    text = {k: json.dumps(v) if isinstance(v, (dict, list)) else str(v) for k, v in figures.items() if k != "state"}
    rows = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in text.items())
    sections = []
    with DemoFile(path) as f:
        names = name_list(f.attrs.get("label_names"))
        for k in chosen:
            demo = f.demo(k)
            shots = pictures(demo, PICTURES)
            seconds = float(demo.time[-1] - demo.time[0])
            attrs = f.own_attrs(k)
            note = ", ".join(f"{a}: {attrs[a]}" for a in ("task", "source", "seed", "success") if a in attrs)
            drawn = "".join(_svg(c, demo.time) for c in charts(demo, f.agent_fields))
            sections.append(
                f"<section><h2>{f.names[k]}: {len(demo)} frames, {seconds:.2f} s "
                f"<small>{html.escape(note)}</small></h2>"
                f'<div class="charts">{_bands(demo, names)}{drawn}</div>'
                f"<aside>{'<img alt=camera>' if shots else ''}"
                f'<input type="range" min="0" max="{len(demo) - 1}" value="0" data-seconds="{seconds:.4f}">'
                f"<output></output>{_from_above(demo)}</aside>"
                f'<script type="application/json">{json.dumps(shots)}</script></section>'
            )
    script = SCRIPT.replace("LEFT", str(LEFT)).replace("SPAN", str(WIDTH - LEFT - 4))
    title = html.escape(path.name)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
        f"<h1>{title}</h1><table>{rows}</table>{''.join(sections)}<script>{script}</script></html>\n"
    )


def strip(path: Path, k: int):
    """A picture: camera frames where there are any, and the curves."""
    from PIL import Image, ImageDraw

    with DemoFile(path) as f:
        demo, fields, name = f.demo(k), f.agent_fields, f.names[k]
    drawn = charts(demo, fields)
    shots = [Image.open(io.BytesIO(base64.b64decode(b))) for _, b in pictures(demo, 6)]
    scale, top = 2, 40
    width, height = WIDTH * scale, (HEIGHT + 20) * scale
    tall = max((s.height * (width // 6) // s.width for s in shots), default=0)
    image = Image.new("RGB", (width, top + tall + height * len(drawn)), "white")
    draw = ImageDraw.Draw(image)
    draw.text((10, 12), f"{path.name} {name}: {len(demo)} frames, {demo.attrs.get('task', '')}", fill="black")
    for i, shot in enumerate(shots):
        image.paste(shot.resize((width // 6, shot.height * (width // 6) // shot.width)), (i * (width // 6), top))
    span = max(float(demo.time[-1] - demo.time[0]), 1e-9)
    for c, chart in enumerate(drawn):
        y0 = top + tall + c * height + 16 * scale
        low, high = _scale(chart)
        draw.text((LEFT * scale, y0 - 14 * scale), f"{chart.title} [{chart.unit}]", fill="black")
        draw.rectangle((LEFT * scale, y0, width - 8, y0 + HEIGHT * scale), outline="#dddddd")
        draw.text((4, y0), f"{high:.3g}", fill="black")
        draw.text((4, y0 + HEIGHT * scale - 12), f"{low:.3g}", fill="black")
        for i, y in enumerate(chart.curves.values()):
            t, v = _thin(demo.time, np.asarray(y, float))
            x = LEFT * scale + (t - demo.time[0]) / span * (width - LEFT * scale - 8)
            h = y0 + (1 - (v - low) / (high - low)) * HEIGHT * scale
            for a in range(len(x) - 1):
                if np.isfinite(h[a]) and np.isfinite(h[a + 1]):
                    draw.line((x[a], h[a], x[a + 1], h[a + 1]), fill=COLOURS[i % len(COLOURS)], width=2)
    return image


def to_rerun(path: Path, chosen: list[int], save: Path | None = None) -> None:
    """Opens the rerun viewer, or writes `save` (.rrd) for it."""
    try:
        import rerun as rr
    except ImportError:
        raise UserError("rerun is not installed: pip install rerun-sdk") from None
    rr.init("intabs", spawn=save is None)
    if save is not None:
        rr.save(str(save))
    with DemoFile(path) as f:
        for k in chosen:
            demo, name = f.demo(k), f.names[k]
            time = rr.TimeColumn("time", duration=demo.time - demo.time[0])
            for chart in charts(demo, f.agent_fields):
                for curve, y in chart.curves.items():
                    where = f"{name}/{chart.title}/{curve}".replace(" ", "_").replace(":", "")
                    rr.send_columns(where, indexes=[time], columns=rr.Scalars.columns(scalars=np.asarray(y, float)))
            for i in range(demo.object_pose.shape[1]):
                if demo.object_valid[:, i].any():
                    rr.send_columns(
                        f"{name}/world/object_{i}", indexes=[time],
                        columns=rr.Transform3D.columns(
                            translation=demo.object_pose[:, i, :3], quaternion=xyzw(demo.object_pose[:, i, 3:])
                        ),
                    )  # fmt: skip
            for key, value in demo.obs.items():
                if value.ndim == 4 and value.dtype == np.uint8:
                    for t, shot in zip(demo.time - demo.time[0], value, strict=True):
                        rr.set_time("time", duration=float(t))
                        rr.log(f"{name}/{key}", rr.Image(shot))


def to_viser(path: Path, k: int, wait) -> None:
    """Serves the objects' poses of one demonstration to a browser. `wait` returns when it is to end."""
    try:
        import viser
    except ImportError:
        raise UserError("viser is not installed: pip install viser") from None
    with DemoFile(path) as f:
        demo, name = f.demo(k), f.names[k]
    server = viser.ViserServer()
    server.scene.add_grid("/table", width=1.0, height=1.0)
    frames = [server.scene.add_frame(f"/object_{i}", axes_length=0.05, axes_radius=0.003)
              for i in range(demo.object_pose.shape[1])]  # fmt: skip
    bar = server.gui.add_slider(f"frame of {name}", min=0, max=len(demo) - 1, step=1, initial_value=0)

    def show(_event=None) -> None:
        for i, frame in enumerate(frames):
            pose = demo.object_pose[int(bar.value), i]
            frame.visible = bool(demo.object_valid[int(bar.value), i])
            frame.position, frame.wxyz = pose[:3], pose[3:]

    bar.on_update(show)
    show()
    wait()
    server.stop()
