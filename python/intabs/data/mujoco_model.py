"""The order of joints in a MuJoCo model's qpos and qvel, from its XML: bodies depth first, the joints of a body in
their order. MuJoCo itself is not needed."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

from intabs.errors import UserError

SIZES = {"hinge": (1, 1), "slide": (1, 1), "ball": (4, 3), "free": (7, 6)}


@dataclass
class Joint:
    name: str
    body: str
    kind: str  # hinge, slide, ball, free
    qpos: int  # first index
    qvel: int
    bodies: tuple[str, ...]  # from the root to `body`


@dataclass
class Model:
    joints: list[Joint]
    nq: int
    nv: int


def parse(xml: str, where: str) -> Model:
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as e:
        raise UserError(f"{where}: not XML ({e})") from None
    # These make joints that are not written down.
    for odd in ("include", "composite", "flexcomp", "replicate", "attach"):
        if root.find(f".//{odd}") is not None:
            raise UserError(f"{where}: uses <{odd}>; save the model in one piece (mj_saveLastXML)")
    if any(j.get("type") for d in root.findall(".//default") for j in d.findall("joint")):
        raise UserError(f"{where}: a default sets the type of joints; save the model in one piece (mj_saveLastXML)")
    world = root.find("worldbody")
    if world is None:
        raise UserError(f"{where}: has no <worldbody>")
    model = Model([], 0, 0)
    _visit(world, (), model, where)
    return model


def _visit(element: ElementTree.Element, bodies: tuple[str, ...], model: Model, where: str) -> None:
    if len(bodies) > 200:
        raise UserError(f"{where}: bodies nested too deep")
    for child in _children(element):
        if child.tag in ("joint", "freejoint"):
            kind = "free" if child.tag == "freejoint" else child.get("type", "hinge")
            if kind not in SIZES:
                raise UserError(f"{where}: joint of unknown type '{kind}'")
            body = bodies[-1] if bodies else ""
            model.joints.append(Joint(child.get("name") or body, body, kind, model.nq, model.nv, bodies))
            model.nq += SIZES[kind][0]
            model.nv += SIZES[kind][1]
    for child in _children(element):
        if child.tag == "body":
            _visit(child, (*bodies, child.get("name", "")), model, where)


def _children(element: ElementTree.Element):
    """<frame> groups elements and is nothing by itself."""
    for child in element:
        if child.tag == "frame":
            yield from _children(child)
        else:
            yield child
