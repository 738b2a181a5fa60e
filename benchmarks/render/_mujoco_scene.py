"""Export of a RoboXim scene to MuJoCo, with the same meshes, textures, sun and cameras; every body is a mocap body."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from PIL import Image

from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import CameraSpec
from roboxim_core.vision.renderer import RenderWorld, TriangleMesh
from roboxim_core.vision.srgb import to_srgb
from roboxim_sim.rendering import textures
from roboxim_sim.rendering.geometry import textured

Views = Sequence[tuple[CameraSpec, Pose]]
OPTICAL_TO_GL = Pose(quat_xyzw=(1.0, 0.0, 0.0, 0.0))
"""MuJoCo's cameras look along -z with y upwards."""


def write_scene(folder: Path, world: RenderWorld, frames: Sequence[tuple[dict[str, Pose], Views]]) -> None:
    """Write ``scene.xml``, its meshes and textures, and ``frames.json``: poses of bodies and cameras by frame."""
    assets, bodies = [], []
    size = frames[0][1][0][0].width
    for name in sorted({part.material.texture for body in world.bodies for part in body.parts} - {""}):
        srgb = to_srgb((textures.pixels(name)[::-1] / 255.0) ** 2)
        Image.fromarray(np.rint(255 * srgb).astype(np.uint8)).save(folder / f"{name}.png")
        assets.append(f'<texture name="{name}" type="2d" file="{name}.png"/>')
    count = 0
    for body in world.bodies:
        geoms = []
        for part in body.parts:
            count += 1
            texture, color = part.material.texture, " ".join(f"{c:.4f}" for c in part.material.color)
            (folder / f"m{count}.obj").write_text(_obj(textured(part.mesh) if texture else part.mesh))
            assets.append(f'<mesh name="m{count}" file="m{count}.obj" inertia="shell"/>')
            with_texture = f' texture="{texture}"' if texture else ""
            gloss = 0.5 * (1 - part.material.roughness)
            assets.append(f'<material name="m{count}" rgba="{color} 1" specular="{gloss:.3f}"{with_texture}/>')
            geoms.append(f'<geom type="mesh" mesh="m{count}" material="m{count}" contype="0" conaffinity="0"/>')
        bodies.append(f'<body name={quoteattr(body.key)} mocap="true">{"".join(geoms)}</body>')
    for camera, _ in frames[0][1]:
        fov = f'<camera name="{camera.name}" fovy="{math.degrees(camera.fov_y_rad):.6f}"/>'
        bodies.append(f'<body name="camera {camera.name}" mocap="true">{fov}</body>')
    light = world.look.lights[0]
    ambient = " ".join(f"{0.6 * c:.3f}" for c in world.look.ambient)
    (folder / "scene.xml").write_text(f"""<mujoco>
  <compiler meshdir="." texturedir="."/>
  <visual>
    <headlight ambient="{ambient}" diffuse="0 0 0" specular="0 0 0"/>
    <global offwidth="{size}" offheight="{size}"/>
    <quality shadowsize="1024" offsamples="4"/>
    <map znear="0.005" zfar="20"/>
  </visual>
  <statistic extent="1" center="0.4 0 0.2"/>
  <asset>{"".join(assets)}</asset>
  <worldbody>
    <light directional="true" castshadow="{str(light.shadow).lower()}" dir="{" ".join(map(str, light.direction))}"
           pos="{" ".join(str(-2 * c) for c in light.direction)}" diffuse="0.6 0.6 0.6"/>
    {"".join(bodies)}
  </worldbody>
</mujoco>
""")
    rows = []
    for poses, views in frames:
        placed = [poses.get(body.key, IDENTITY) for body in world.bodies] + [pose @ OPTICAL_TO_GL for _, pose in views]
        quaternions = [(w, x, y, z) for x, y, z, w in (pose.quat_xyzw for pose in placed)]
        rows.append({"positions": [pose.position for pose in placed], "quaternions": quaternions})
    cameras = [camera.name for camera, _ in frames[0][1]]
    (folder / "frames.json").write_text(json.dumps({"size": size, "cameras": cameras, "frames": rows}))


def _obj(mesh: TriangleMesh) -> str:
    """Return a mesh as OBJ; MuJoCo requires solids, so flat meshes get an additional corner slightly below."""
    uv = np.zeros((len(mesh.vertices), 2)) if mesh.uv is None else mesh.uv
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.normals.tolist()]
    lines += [f"vt {u:.5f} {v:.5f}" for u, v in uv.tolist()]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}/{i + 1}" for i in face) for face in mesh.faces.tolist()]
    return "\n".join(lines) + "\n"
