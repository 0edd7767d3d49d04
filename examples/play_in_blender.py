"""Render a hand from `oasis export` in a named pose with Blender.

Run `pip install bpy==5.0.1`, then `python examples/play_in_blender.py hand.glb fist fist.png`; or use Blender itself:
`blender -b -P examples/play_in_blender.py -- hand.glb fist fist.png`.
"""

import sys
from math import radians

import bpy  # pyright: ignore[reportMissingImports]

path, pose, picture = sys.argv[-3:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=path)  # of a .usdc: bpy.ops.wm.usd_import, which has the action "poses" alone
skin = next(item for item in bpy.data.objects if item.type == "MESH" and item.find_armature())
for shape in skin.data.shape_keys.key_blocks:
    shape.slider_min = -1  # correctives of MANO may be negative
for owner in (skin.find_armature(), skin.data.shape_keys):
    owner.animation_data.action = bpy.data.actions[pose]  # bones and shape keys play one action
bpy.context.scene.frame_set(int(bpy.data.actions[pose].frame_range[1]))

bpy.ops.object.light_add(type="SUN", rotation=(radians(30), radians(20), 0))
bpy.context.object.data.energy = 4
bpy.ops.object.camera_add(location=(0, 0.07, 0.5))
scene = bpy.context.scene
scene.camera, scene.world = bpy.context.object, bpy.data.worlds.new("even")
scene.render.engine, scene.render.filepath = "CYCLES", picture
scene.cycles.samples, scene.render.resolution_x, scene.render.resolution_y = 16, 512, 512
bpy.ops.render.render(write_still=True)
