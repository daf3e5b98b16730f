"""Compares what Blender makes of a glTF file with the body posed by the numbers of the .npz beside it.

Usage: check.py START.glb [PICTURE.png]. The body is skinned in double precision from checkpoints/body/body.safetensors by the
reference of tests/tools/body; Blender imports the file, moves it to three frames and hands out the vertices it would draw.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "body"))
from lbs_reference import pose_body, read  # noqa: E402

TOLERANCE = 1e-4
FPS = 40


def load(path):
    """Imports the file into an empty scene whose frames are its keyframes; returns the skinned objects."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = FPS
    bpy.ops.import_scene.gltf(filepath=str(path))
    return [o for o in scene.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)]


def evaluated(person, frame):
    """World positions of the posed vertices, z up, in the order of the file."""
    bpy.context.scene.frame_set(frame)
    posed = person.evaluated_get(bpy.context.evaluated_depsgraph_get())
    flat = np.empty(3 * len(posed.data.vertices), np.float32)
    posed.data.vertices.foreach_get("co", flat)
    matrix = np.array(posed.matrix_world)
    return flat.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def origin(body, triangles):
    """The body's vertex that each vertex of the file is, from its triangles."""
    source = np.full(triangles.max() + 1, -1)
    source[triangles.ravel()] = body["faces"].astype(np.int64).ravel()
    return source


def draw(person, path, frame):
    """A picture with Blender's own lighting, looking at the person from in front and above."""
    scene = bpy.context.scene
    points = evaluated(person, frame)
    middle = (points.min(0) + points.max(0)) / 2
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 4, (0.6, 0.3, 0.5)
    for o in (camera, sun):
        scene.collection.objects.link(o)
    camera.location, camera.rotation_euler = middle + np.array([0, -4, 1.6]), (np.pi / 2 - 0.38, 0, 0)
    scene.camera, scene.world = camera, bpy.data.worlds.new("sky")
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 8
    scene.render.resolution_x, scene.render.resolution_y = 480, 480
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def main(path, picture=None):
    motion = np.load(path.with_suffix(".npz"))
    frames = len(motion["poses"])
    body = read("checkpoints/body/body.safetensors")
    people = load(path)
    ends = people[0].parent.animation_data.action.frame_range
    assert len(people) == 1 and np.allclose(ends, (0, frames - 1), atol=1e-3), f"{len(people)} people, frames {tuple(ends)} of {frames}"
    triangles = np.array([p.vertices[:] for p in people[0].data.polygons])
    source = origin(body, triangles)
    for frame in (0, frames // 2, frames - 1):
        params = np.zeros(93)
        params[:3], params[3:69] = motion["trans"][frame], motion["poses"][frame, :66]
        want, _ = pose_body(body, motion["betas"][:10], params)
        worst = np.abs(evaluated(people[0], frame) - want[source]).max()
        print(f"{path.name} frame {frame}: Blender and the body differ by {worst:.1e} m")
        assert worst < TOLERANCE
    if picture:
        draw(people[0], Path(picture).resolve(), frames // 2)


main(Path(sys.argv[1]), *sys.argv[2:3])
