"""Run against an install that has no compiled kernels: the NumPy twins must compare two pictures, and warn once."""

import warnings

import numpy as np

with warnings.catch_warnings(record=True) as given:
    warnings.simplefilter("always")
    import sorvolo
    from sorvolo import kernels

    before = np.random.default_rng(1).integers(60, 120, (96, 128, 3)).astype(np.uint8)
    after = before.copy()
    after[30:60, 40:80] = 250
    found = sorvolo.compare_images(before, after, method="thesis")

warned = [str(each.message) for each in given if "compiled kernels" in str(each.message)]
assert not kernels.COMPILED, "the compiled kernels are here: install with CC=false CXX=false"
assert len(warned) == 1, warned
assert found.mask[45, 60] and not found.mask[5, 5]
assert (found.mask > 0).sum() > 500
