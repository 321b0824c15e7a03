import numpy as np

from streetscan.simulation.appearance import CAR_PAINTS, MATERIAL_IDS, MATERIALS, PALETTES, draw_car_paint, draw_colour, vary_colours


def test_materials_are_physical_and_known_by_name():
    assert len(MATERIALS) == len(MATERIAL_IDS) <= 256
    for i, m in enumerate(MATERIALS):
        assert MATERIAL_IDS[m.name] == i
        assert 0 <= m.transmission < 1
        assert 0 <= m.specularity < 1
        assert m.roughness > 0
        limit = 1000 if m.name == "retroreflector" else 1
        assert 0 < m.reflectance_1550 < limit
        assert 0 < m.reflectance_905 < limit


def test_materials_order_as_in_nature():
    by = {m.name: m for m in MATERIALS}
    # Water in leaves and skin absorbs at 1550 nm.
    assert by["leaves"].reflectance_1550 < by["leaves"].reflectance_905
    assert by["skin"].reflectance_1550 < by["skin"].reflectance_905
    assert by["wet_asphalt"].reflectance_1550 < by["asphalt"].reflectance_1550 < by["marking"].reflectance_1550 < 1
    assert by["paint_black"].reflectance_1550 < 0.1 < by["paint_white"].reflectance_1550
    assert 100 < by["retroreflector"].reflectance_1550 / by["paint_white"].reflectance_1550 < 1000  # 20 to 30 dB
    assert by["glass"].transmission > 0.5


def test_colours_come_from_the_palette_and_vary():
    rng = np.random.default_rng(0)
    for palette, colours in PALETTES.items():
        drawn = np.array([draw_colour(palette, rng) for _ in range(60)])
        distances = np.abs(drawn[:, None] - np.array(colours)[None]).max(axis=2).min(axis=1)
        assert np.median(distances) < 25, palette
        assert len(np.unique(drawn, axis=0)) > 30
        assert drawn.min() >= 0
        assert drawn.max() <= 255


def test_car_paints_follow_their_shares():
    rng = np.random.default_rng(0)
    names = [draw_car_paint(rng)[0] for _ in range(3000)]
    total = sum(share for *_, share in CAR_PAINTS)
    for name in {p[0] for p in CAR_PAINTS}:
        expected = sum(share for material, _, share in CAR_PAINTS if material == name) / total
        assert abs(names.count(name) / 3000 - expected) < 0.03


def test_texture_keeps_the_mean_colour():
    colours = vary_colours((100, 120, 60), 5000, 10, np.random.default_rng(0))
    assert colours.shape == (5000, 3)
    assert colours.dtype == np.uint8
    assert np.abs(colours.mean(axis=0) - [100, 120, 60]).max() < 1.5
    assert 8 < colours[:, 0].std() < 12
