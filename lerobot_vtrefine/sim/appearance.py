"""Colours, lights and textures; nothing here changes the physics."""

import mujoco

Rgba = tuple[float, float, float, float]

DARK: Rgba = (0.13, 0.14, 0.16, 1.0)
GREY: Rgba = (0.42, 0.44, 0.47, 1.0)
PAD: Rgba = (0.10, 0.55, 0.53, 1.0)
PLUG_COLOUR: Rgba = (0.93, 0.47, 0.13, 1.0)
SOCKET_COLOUR: Rgba = (0.16, 0.38, 0.72, 1.0)
UNSEEN: Rgba = (0.0, 0.0, 0.0, 0.0)
"""Neither drawn nor seen by the depth camera."""


def add_appearance(spec: mujoco.MjSpec) -> None:
    """Sky, materials, lights and off-screen size for rendering."""
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.05, 0.05, 0.05]
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 30.0
    spec.stat.extent, spec.stat.center = 0.8, [0.0, 0.0, 0.12]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.86, 0.89, 0.93],
        rgb2=[0.55, 0.62, 0.70],
        width=256,
        height=256,
    )
    spec.add_texture(
        name="table",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.80, 0.77, 0.72],
        markrgb=[0.70, 0.67, 0.62],
        width=256,
        height=256,
    )
    table = spec.add_material(
        name="table", texrepeat=[10, 10], texuniform=True, specular=0.1, reflectance=0.0
    )
    table.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "table"
    spec.add_material(name="floor", rgba=[0.45, 0.47, 0.50, 1.0])
    kind = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        pos=[-0.3, -0.2, 1.0], dir=[0.3, 0.2, -1.0], diffuse=[0.5, 0.48, 0.45], castshadow=True, type=kind
    )
    spec.worldbody.add_light(
        pos=[0.8, 0.6, 1.4], dir=[-0.5, -0.4, -1.0], diffuse=[0.25, 0.27, 0.3], castshadow=False, type=kind
    )
