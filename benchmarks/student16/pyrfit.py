import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import pickle, numpy as np
from scipy.optimize import minimize_scalar

rows = []
for k in (0, 1):
    rows += pickle.load(open(STUDENT + f"/pyr{k}.pkl", "rb"))[0]
for c, slope in ((0, 2.743), (1, 3.635)):
    r = [x for x in rows if x[0] == c and x[1] >= 0.1]
    p = np.clip([x[1] for x in r], 1e-6, 1 - 1e-6)
    z = np.log(p / (1 - p))
    y = np.array([x[2] for x in r])
    g = np.array([x[3] for x in r])
    f = lambda d: np.mean(np.logaddexp(0, z + d) - y * (z + d))
    d = minimize_scalar(f, bounds=(-6, 3), method="bounded").x
    print(
        "person car".split()[c],
        len(r),
        y.sum(),
        "offset %.2f new shift %.2f" % (d, 0.6 + d / slope),
    )
    for t in (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
        print(
            "  from %.1f right %d false %s"
            % (
                t,
                ((p >= t) & (y == 1)).sum(),
                {nm: int(((p >= t) & (y == 0) & (g == nm)).sum()) for nm in set(g)},
            )
        )
