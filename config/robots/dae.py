"""Reader for the COLLADA files of `example-robot-data`; supports triangles, matrices and diffuse colours only."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh


def read_collada(path: Path, *, linear: bool = False) -> list[tuple[tuple[int, ...], trimesh.Trimesh]]:
    """Return the colour (sRGB, 0..255) and the transformed mesh of each part of each geometry.

    Args:
        path: The file.
        linear: Whether the file's colours are linear.

    Raises:
        ValueError: When the file uses features that this reader does not support.
    """
    root = ElementTree.fromstring(re.sub(r' xmlns="[^"]*"', "", path.read_text(), count=1))
    by_id = {f"#{element.get('id')}": element for element in root.iter() if element.get("id")}
    found = []
    try:
        for node in root.iter("node"):
            instance = node.find("instance_geometry")
            if instance is not None:
                matrix = np.array(node.find("matrix").text.split(), dtype=float).reshape(4, 4)
                materials = {e.get("symbol"): e.get("target") for e in instance.iter("instance_material")}
                for triangles in by_id[instance.get("url")].findall("mesh/triangles"):
                    effect = by_id[by_id[materials[triangles.get("material")]].find("instance_effect").get("url")]
                    diffuse = np.array(effect.find(".//diffuse/color").text.split()[:3], dtype=float)
                    mesh = _mesh(triangles, by_id)
                    mesh.apply_transform(matrix)
                    color = tuple(int(c) for c in np.rint(255 * diffuse))
                    found.append((tuple(round(255 * (c / 255) ** (1 / 2.2)) for c in color) if linear else color, mesh))
    except (AttributeError, KeyError) as error:
        raise ValueError(f"{path} has more than triangles, matrices and diffuse colours: {error}") from None
    return found


def _mesh(triangles: ElementTree.Element, by_id: dict[str, ElementTree.Element]) -> trimesh.Trimesh:
    inputs = {e.get("semantic"): (int(e.get("offset")), by_id[e.get("source")]) for e in triangles.iter("input")}
    offset, vertices = inputs["VERTEX"]
    positions = by_id[vertices.find("input[@semantic='POSITION']").get("source")]
    points = np.array(positions.find("float_array").text.split(), dtype=float).reshape(-1, 3)
    stride = 1 + max(number for number, _ in inputs.values())
    index = np.array(triangles.find("p").text.split(), dtype=int).reshape(-1, stride)
    return trimesh.Trimesh(points, index[:, offset].reshape(-1, 3), process=False)
