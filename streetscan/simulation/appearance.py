"""What surfaces look like to a laser and to a camera: the table of materials, and palettes of base colours.

Reflectances are those of a diffuse white target = 1 at normal incidence. 905 nm stands for the rotating multi-beam
lidar (Velodyne HDL-64), 1550 nm for the mobile mapping scanner (Riegl VQ-450).

Sources: orders of magnitude of the spectral libraries (ECOSTRESS/ASTER: asphalt, concrete, brick, roofing; leaf
water absorption at 1450 and 1940 nm makes leaves and skin darker at 1550 than at 905 nm).
ASSUME: the exact figures, the share of pulses a pane lets through, and the gloss are ours; the papers give none. They are
such that the surfaces laser scanners are known to lose (panes, black paint, wet road) answer only near by or squarely, and that
retro-reflective sheeting answers some 25 dB above a white wall.
"""

from typing import NamedTuple

import numpy as np


class Material(NamedTuple):
    """One material.

    Attributes:
        name: its key.
        reflectance_1550, reflectance_905: diffuse reflectance; above 1 for retro-reflectors (apparent, towards the source).
        transmission: probability that a pulse passes through without a return.
        specularity: share of the reflected power in the mirror direction, lost to the sensor unless it looks along the normal.
        roughness: width (radians, 1 sigma) of the mirror lobe.
    """

    name: str
    reflectance_1550: float
    reflectance_905: float
    transmission: float = 0.0
    specularity: float = 0.0
    roughness: float = 0.6


MATERIALS = (
    Material("asphalt", 0.18, 0.14),
    Material("wet_asphalt", 0.03, 0.05, specularity=0.8, roughness=0.10),
    Material("marking", 0.55, 0.70),
    Material("concrete", 0.38, 0.35),
    Material("paving", 0.33, 0.30),
    Material("brick", 0.45, 0.36),
    Material("plaster", 0.62, 0.60),
    Material("stone", 0.45, 0.42),
    Material("roof_tile", 0.40, 0.32),
    Material("glass", 0.04, 0.05, transmission=0.70, specularity=0.96, roughness=0.02),
    Material("car_glass", 0.04, 0.05, transmission=0.45, specularity=0.96, roughness=0.02),
    Material("paint_white", 0.70, 0.72, specularity=0.25, roughness=0.10),
    Material("paint_silver", 0.45, 0.45, specularity=0.45, roughness=0.15),
    Material("paint_colour", 0.50, 0.40, specularity=0.35, roughness=0.10),
    Material("paint_dark", 0.10, 0.09, specularity=0.60, roughness=0.08),
    Material("paint_black", 0.03, 0.03, specularity=0.75, roughness=0.06),
    Material("metal", 0.45, 0.40, specularity=0.40, roughness=0.25),
    Material("painted_metal", 0.40, 0.30, specularity=0.15, roughness=0.30),
    Material("rail", 0.30, 0.25, specularity=0.70, roughness=0.10),
    Material("retroreflector", 300.0, 300.0, roughness=0.05),
    Material("leaves", 0.28, 0.48, transmission=0.05),
    Material("bark", 0.38, 0.28),
    Material("grass", 0.24, 0.45),
    Material("soil", 0.32, 0.20),
    Material("gravel", 0.40, 0.32),
    Material("wood", 0.50, 0.45),
    Material("plastic", 0.45, 0.40, specularity=0.10, roughness=0.30),
    Material("rubber", 0.05, 0.04),
    Material("cloth", 0.45, 0.42),
    Material("cloth_dark", 0.25, 0.18),
    Material("skin", 0.12, 0.48),
    Material("hair", 0.15, 0.20),
    Material("interior", 0.35, 0.30),
    Material("water", 0.02, 0.03, transmission=0.55, specularity=0.95, roughness=0.05),
)
MATERIAL_IDS = {m.name: i for i, m in enumerate(MATERIALS)}

RUBBER, CHROME, DARK = (28, 28, 28), (150, 152, 154), (34, 34, 36)

# Base colours, RGB: of one family an instance draws one and varies it.
PALETTES = {
    "asphalt": [(82, 82, 84), (96, 95, 93), (70, 71, 74)],
    "paving": [(150, 146, 138), (165, 158, 146), (138, 136, 134), (158, 140, 128)],
    "plaster": [
        (226, 209, 165),
        (214, 190, 148),
        (203, 181, 160),
        (232, 225, 206),
        (196, 172, 140),
        (187, 190, 180),
        (217, 169, 132),
        (172, 186, 196),
        (208, 200, 190),
        (221, 186, 180),
    ],
    "brick": [(150, 82, 62), (170, 100, 74), (126, 74, 60), (182, 140, 100)],
    "stone": [(176, 170, 158), (160, 150, 134), (192, 184, 168)],
    "roof": [(142, 74, 52), (120, 64, 50), (90, 88, 90), (104, 84, 70)],
    "door": [(82, 52, 34), (44, 62, 48), (60, 60, 66), (110, 74, 44), (92, 30, 28)],
    "shop": [(160, 30, 36), (30, 70, 130), (30, 100, 60), (220, 180, 40), (40, 40, 44), (230, 226, 216), (120, 60, 130)],
    "leaves": [(62, 104, 40), (78, 118, 46), (52, 92, 44), (96, 126, 52), (70, 96, 62), (112, 120, 48)],
    "bark": [(92, 76, 60), (110, 96, 80), (132, 124, 108), (70, 58, 46)],
    "grass": [(86, 120, 52), (100, 126, 60), (76, 108, 48)],
    "pole": [(70, 74, 76), (40, 52, 46), (128, 130, 130), (48, 48, 50), (92, 100, 88)],
    "furniture": [(62, 74, 62), (100, 70, 44), (52, 56, 64), (140, 44, 36), (168, 164, 150), (206, 160, 30), (36, 84, 120)],
    "cloth": [
        (40, 44, 60),
        (90, 30, 34),
        (30, 60, 44),
        (150, 140, 120),
        (60, 60, 64),
        (190, 182, 170),
        (170, 60, 50),
        (50, 90, 140),
        (200, 170, 60),
        (24, 24, 28),
    ],
    "skin": [(224, 184, 156), (196, 148, 116), (150, 104, 78), (232, 200, 176), (104, 72, 54)],
    "hair": [(40, 30, 24), (84, 60, 40), (150, 120, 80), (110, 108, 106), (26, 24, 24)],
    "tram": [(232, 196, 32), (206, 40, 40), (236, 236, 230), (40, 110, 70)],
    "bus": [(28, 92, 170), (204, 44, 44), (236, 232, 220), (36, 130, 80), (110, 60, 120)],
    "truck": [(232, 232, 228), (210, 60, 40), (40, 80, 140), (200, 200, 204), (222, 170, 40)],
}

# Car paints: material, colour and how common (shares of new cars in Europe, rounded).
CAR_PAINTS = (
    ("paint_white", (236, 236, 234), 0.25),
    ("paint_black", (22, 22, 24), 0.20),
    ("paint_dark", (74, 78, 82), 0.18),
    ("paint_silver", (178, 180, 182), 0.13),
    ("paint_dark", (28, 44, 84), 0.07),
    ("paint_colour", (52, 92, 158), 0.05),
    ("paint_colour", (164, 28, 30), 0.06),
    ("paint_colour", (54, 96, 60), 0.02),
    ("paint_colour", (206, 178, 48), 0.02),
    ("paint_colour", (140, 110, 84), 0.02),
)


def draw_colour(palette: str, rng: np.random.Generator, spread: float = 10.0) -> tuple[int, int, int]:
    """One RGB colour of a palette, varied by `spread` (1 sigma, of 255) in brightness and half of it per channel."""
    colours = PALETTES[palette]
    base = np.array(colours[rng.integers(len(colours))], float) + rng.normal(0, spread) + rng.normal(0, spread / 2, 3)
    return tuple(int(v) for v in np.clip(base, 5, 250))


def draw_car_paint(rng: np.random.Generator) -> tuple[str, tuple[int, int, int]]:
    """Material name and RGB colour of one car."""
    shares = np.array([share for *_, share in CAR_PAINTS])
    material, colour, _ = CAR_PAINTS[rng.choice(len(CAR_PAINTS), p=shares / shares.sum())]
    return material, tuple(int(v) for v in np.clip(np.array(colour) + rng.normal(0, 6, 3), 5, 250))


def vary_colours(colour: tuple[int, int, int], n: int, spread: float, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) uint8 colours around one, varied in brightness by `spread` (1 sigma, of 255): texture, one per triangle."""
    return np.clip(np.asarray(colour, float) + rng.normal(0, spread, (n, 1)), 0, 255).astype(np.uint8)
