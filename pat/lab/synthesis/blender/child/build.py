"""Construction of a scene's objects, materials and lights in Blender."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from . import compat

Spectrum = Literal["rgb", "nir"]
Part = Any
"""A part of a `pat.lab.synthesis.scene.Scene`, under the same names."""

_STEPS = {"voronoi", "brick", "checker"}


@dataclass(frozen=True)
class BuiltScene:
    """Scene built in Blender.

    Attributes:
        objects: Blender's objects, in the scene's order.
        paints: functions that set one colour each for a spectrum.
    """

    objects: list[Any]
    paints: list[Callable[[Spectrum], None]]

    def show(self, spectrum: Spectrum) -> None:
        """Set all surfaces and lights to a spectrum, in place; near infrared is grey."""
        for paint in self.paints:
            paint(spectrum)


def build(bpy: Any, scene: Part, meshes: Sequence[Part], world: Any) -> BuiltScene:
    """Build all objects and lights of a scene in Blender.

    Args:
        bpy: Blender's module.
        meshes: the objects' shapes in their order, with the attributes of `pat.lab.synthesis.shapes.Mesh`.
        world: Blender's world, for the light from all around.

    Returns:
        The built scene; call `show` before rendering.

    Raises:
        ValueError: for a texture whose image file is missing.
        KeyError: for an unknown kind of texture. Errors of Blender pass, such as for an unknown light.
    """
    stage = BuiltScene([], [])
    for i, (thing, surface) in enumerate(zip(scene.objects, meshes)):
        item = _object(bpy, thing, surface)
        item.pass_index = i + 1
        item.data.materials.append(_material(bpy, thing, stage))
        stage.objects.append(item)
    for light in scene.lights:
        _light(bpy, light, stage)
    sky, shown = world.node_tree.nodes["Background"].inputs["Color"], scene.world
    stage.paints.append(lambda spectrum: _set_colour(sky, "default_value", spectrum, shown))
    return stage


def colour(spectrum: Spectrum, rgb: tuple[float, float, float], nir: float) -> tuple[float, float, float]:
    """Choose the colour to render for a spectrum.

    Args:
        spectrum: "rgb" or "nir".
        rgb: linear red, green and blue.
        nir: value in near infrared.

    Returns:
        `rgb`, or `nir` in all three channels.
    """
    return rgb if spectrum == "rgb" else (nir, nir, nir)


def _set_colour(item: Any, name: str, spectrum: Spectrum, shown: Part) -> None:
    setattr(item, name, (*colour(spectrum, shown.rgb, shown.nir), 1.0))


def _object(bpy: Any, thing: Part, surface: Part) -> Any:
    data = bpy.data.meshes.new(thing.name)
    faces = [f[:3] if f[2] == f[3] else f for f in surface.faces]
    data.from_pydata(surface.vertices, [], faces)
    uv = np.concatenate([c[: len(f)] for f, c in zip(faces, surface.uv)])
    data.uv_layers.new(name="UVMap").data.foreach_set("uv", uv.astype(np.float32).ravel())
    data.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
    item = bpy.data.objects.new(thing.name, data)
    item.rotation_mode = "QUATERNION"
    item.visible_shadow = thing.shape != "room"
    bpy.context.scene.collection.objects.link(item)
    return item


_SIZES = {"area": "size", "sun": "angle", "point": "shadow_soft_size"}


def _light(bpy: Any, light: Part, stage: BuiltScene) -> None:
    data = bpy.data.lights.new(light.kind, light.kind.upper())
    data.energy = light.power
    setattr(data, _SIZES[light.kind], light.size)
    item = bpy.data.objects.new(light.kind, data)
    item.location = light.position
    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = _towards(light.direction)
    item.visible_camera = False
    bpy.context.scene.collection.objects.link(item)
    stage.paints.append(lambda spectrum: setattr(data, "color", colour(spectrum, light.rgb, light.nir)))


def _towards(direction: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) that rotates -z, the axis of lamps, to a direction."""
    d = np.asarray(direction) / np.linalg.norm(direction)
    if d[2] > 1 - 1e-9:
        return 0.0, 1.0, 0.0, 0.0
    q = np.array([1 - d[2], d[1], -d[0], 0.0])
    w, x, y, z = q / np.linalg.norm(q)
    return w, x, y, z


# Materials --------------------------------------------------------------------------------------------------


class _Nodes:
    """Node tree with shorthand for the operations in use."""

    def __init__(self, tree: Any):
        self.tree = tree

    def new(self, kind: str, **settings: Any) -> Any:
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for name, value in settings.items():
            setattr(node, name, value)
        return node

    def give(self, socket: Any, value: Any) -> None:
        """Connect an output to an input, or set the input."""
        if hasattr(value, "is_linked"):
            self.tree.links.new(value, socket)
        else:
            socket.default_value = value

    def vector(self, operation: str, *values: Any) -> Any:
        return self.number(operation, *values, kind="VectorMath")

    def number(self, operation: str, *values: Any, kind: str = "Math") -> Any:
        node = self.new(kind, operation=operation)
        for socket, value in zip(node.inputs, values):
            self.give(socket, value)
        return node.outputs[0]

    def texture(self, kind: str, coordinates: Any, **inputs: Any) -> Any:
        """Add a texture node at these coordinates, with values of further inputs."""
        node = self.new(f"Tex{kind}")
        self.give(node.inputs["Vector"], coordinates)
        for name, value in inputs.items():
            node.inputs[name].default_value = value
        return node


def _material(bpy: Any, thing: Part, stage: BuiltScene) -> Any:
    material = thing.material
    made = bpy.data.materials.new(thing.name)
    compat.use_nodes(made)
    nodes = _Nodes(made.node_tree)
    shader = made.node_tree.nodes["Principled BSDF"]
    paint, height = _texture(bpy, nodes, material.texture, stage)
    inputs = {
        "Roughness": material.roughness,
        "Specular IOR Level": material.specular,
        "Metallic": material.metallic,
        "Transmission Weight": material.transmission,
        "Emission Strength": material.emission,
    }
    for name, value in inputs.items():
        shader.inputs[name].default_value = value
    nodes.give(shader.inputs["Base Color"], paint)
    if material.emission:
        nodes.give(shader.inputs["Emission Color"], paint)
    if material.bump and height is not None:
        bump = nodes.new("Bump")
        bump.inputs["Distance"].default_value = material.bump
        nodes.give(bump.inputs["Height"], height)
        nodes.give(shader.inputs["Normal"], bump.outputs[0])
    return made


def _texture(bpy: Any, nodes: _Nodes, texture: Part, stage: BuiltScene) -> tuple[Any, Any]:
    """Outputs of colour and of bump height (None for images)."""
    if texture.kind == "image":
        return _image(bpy, nodes, texture, stage), None
    height = _PATTERNS[texture.kind](nodes, texture)
    ramp = nodes.new("ValToRGB")
    nodes.give(ramp.inputs[0], height)
    _set_ramp(ramp.color_ramp, texture)
    stage.paints.append(lambda spectrum: _paint_ramp(ramp.color_ramp, texture.paints, spectrum))
    return _grained(nodes, texture, ramp.outputs[0]), height


def _set_ramp(ramp: Any, texture: Part) -> None:
    """Place one stop for each paint; stepped patterns stay stepped."""
    stepped = texture.kind in _STEPS
    ramp.interpolation = "CONSTANT" if stepped else "LINEAR"
    n = len(texture.paints)
    low, high = (0.35, 0.65) if texture.kind == "noise" else (0.0, 1.0)
    stops = [i / n if stepped else low + (high - low) * i / max(n - 1, 1) for i in range(n)]
    ramp.elements.remove(ramp.elements[1])
    ramp.elements[0].position = stops[0]
    for stop in stops[1:]:
        ramp.elements.new(stop)


def _paint_ramp(ramp: Any, paints: Sequence[Part], spectrum: Spectrum) -> None:
    for stop, paint in zip(ramp.elements, paints):
        _set_colour(stop, "color", spectrum, paint)


def _coordinates(nodes: _Nodes, texture: Part, source: str = "Object", scale: float = 1.0) -> Any:
    """Texture coordinates, of the object or along its surface, times the scale, shifted."""
    where = nodes.new("TexCoord").outputs[source]
    return nodes.vector("MULTIPLY_ADD", where, (scale * texture.scale,) * 3, texture.offset)


def _grained(nodes: _Nodes, texture: Part, paint: Any) -> Any:
    if not texture.grain:
        return paint
    noise = nodes.texture("Noise", _coordinates(nodes, texture, scale=4.0), Scale=1.0, Detail=3.0)
    grain = nodes.number("MULTIPLY_ADD", compat.factor(noise), 3 * texture.grain, 1 - 1.5 * texture.grain)
    node = nodes.new("VectorMath", operation="SCALE")
    nodes.give(node.inputs[0], paint)
    nodes.give(node.inputs["Scale"], grain)
    return node.outputs[0]


def _pattern(kind: str, **inputs: float) -> Callable[[_Nodes, Part], Any]:
    def make(nodes: _Nodes, texture: Part) -> Any:
        node = nodes.texture(kind, _coordinates(nodes, texture), **inputs)
        if "Distortion" in node.inputs and texture.distortion:
            node.inputs["Distortion"].default_value = texture.distortion
        return compat.factor(node)

    return make


def _voronoi(nodes: _Nodes, texture: Part) -> Any:
    node = nodes.texture("Voronoi", _coordinates(nodes, texture), Scale=1.0)
    split = nodes.new("SeparateXYZ")
    nodes.give(split.inputs[0], node.outputs["Color"])
    return split.outputs[0]


def _brick(nodes: _Nodes, texture: Part) -> Any:
    greys = {"Color1": (0.0, 0.0, 0.0, 1.0), "Color2": (0.7, 0.7, 0.7, 1.0), "Mortar": (1.0, 1.0, 1.0, 1.0)}
    return nodes.texture("Brick", _coordinates(nodes, texture, "UV"), **greys, Scale=0.5).outputs["Color"]


def _plain(nodes: _Nodes, texture: Part) -> Any:
    node = nodes.new("Value")
    node.outputs[0].default_value = 0.0
    return node.outputs[0]


_PATTERNS: dict[str, Callable[[_Nodes, Part], Any]] = {
    "plain": _plain,
    "voronoi": _voronoi,
    "magic": _pattern("Magic", Scale=1.0),
    "brick": _brick,
    "checker": _pattern("Checker", Scale=1.0),
    "noise": _pattern("Noise", Scale=1.0, Detail=3.0),
    "wave": _pattern("Wave", Scale=0.3),
}


def _image(bpy: Any, nodes: _Nodes, texture: Part, stage: BuiltScene) -> Any:
    file = Path(texture.image)
    if not file.is_file():
        raise ValueError(f"{texture.image or 'a texture without a file'}: no such image for a texture")
    image = bpy.data.images.load(str(file.resolve()), check_existing=True)
    node = nodes.new("TexImage", image=image, extension="MIRROR")
    w, h = 1 / texture.scale, image.size[1] / image.size[0] / texture.scale
    onto = (1 / w, -1 / h, 0), (texture.offset[0], 1 + texture.offset[1], 0)
    where = nodes.vector("MULTIPLY_ADD", nodes.new("TexCoord").outputs["UV"], *onto)
    nodes.give(node.inputs["Vector"], where)
    rgb = node.outputs["Color"]
    infrared = nodes.vector("SUBTRACT", _infrared(nodes, rgb), rgb)
    mix = nodes.vector("MULTIPLY_ADD", infrared, (0, 0, 0), rgb)
    paint = nodes.vector("MULTIPLY", mix, (1, 1, 1))
    switch, tint = mix.node.inputs[1], paint.node.inputs[1]

    def show(spectrum: Spectrum) -> None:
        switch.default_value = colour(spectrum, (0, 0, 0), 1)
        tint.default_value = colour(spectrum, texture.paints[0].rgb, texture.paints[0].nir)

    stage.paints.append(show)
    return _grained(nodes, texture, paint)


def _infrared(nodes: _Nodes, rgb: Any) -> Any:
    """Near infrared in all channels: red plus 1.5 times the excess of green over red and blue, at most 1."""
    split = nodes.new("SeparateXYZ")
    nodes.give(split.inputs[0], rgb)
    red, green, blue = split.outputs
    excess = nodes.number("MAXIMUM", nodes.number("SUBTRACT", green, nodes.number("MAXIMUM", red, blue)), 0.0)
    value = nodes.number("MINIMUM", nodes.number("MULTIPLY_ADD", excess, 1.5, red), 1.0)
    joined = nodes.new("CombineXYZ")
    for socket in joined.inputs:
        nodes.give(socket, value)
    return joined.outputs[0]
