"""The true heights of a simulated day, seen from above."""

import numpy as np
from true_heights import surface_heights

from sorvolo.search.drawing.bodies import build_body
from sorvolo.search.drawing.objects import Light, Thing, ThingLabel
from sorvolo.search.drawing.view import map_view


def test_roofs_have_their_height_and_gables_slope_to_the_eaves() -> None:
    light = Light(np.array([0.3, 0.2, 0.93]))
    flat = Thing(1, ThingLabel.HOUSE, "flat roof", -10.0, 0.0, 0.0, (8.0, 6.0, 5.0), 3)
    gabled = Thing(2, ThingLabel.HOUSE, "gable roof", 10.0, 0.0, 0.0, (8.0, 6.0, 5.0), 4)
    bodies = {each.id: build_body(each, light, 0.1) for each in (flat, gabled)}
    view = map_view(-20.0, 10.0, (0.1, 0.1), (400, 200))
    heights = surface_heights((flat, gabled), bodies, view)
    assert heights[5, 5] == 0 and heights[100, 200] == 0
    assert 4.9 < np.median(heights[80:120, 70:130]) < 6.5  # with what stands on the roof
    ridge, eaves = heights[100, 300], heights[75, 300]
    assert abs(ridge - 5.0) < 0.1 and 3.0 < eaves < 4.2
