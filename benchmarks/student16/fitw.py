import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import pickle, numpy as np
from scipy.optimize import minimize
from collections import Counter

lo = lambda p, l: np.log(np.clip(p, l, 1 - l) / (1 - np.clip(p, l, 1 - l)))
rows, n, pics = pickle.load(open(STUDENT + "/rows3.pkl", "rb"))
print(Counter((r[0], r[3]) for r in rows))


def fit(keep, label):
    R = [r for r in rows if keep(r)]
    own = lo(np.minimum([r[1] for r in R], 0.98), 1e-3)
    ag = np.array([r[2] for r in R])
    y = np.array([r[3] for r in R], float)
    f = lambda w: (
        np.mean(
            np.logaddexp(0, w[0] * own + w[1] * ag + w[2]) - y * (w[0] * own + w[1] * ag + w[2])
        )
        + 1e-3 * (w[0] ** 2 + w[1] ** 2)
    )
    f1 = lambda w: np.mean(np.logaddexp(0, w[0] * own + w[1]) - y * (w[0] * own + w[1]))
    a = minimize(f, [1, 0.5, 0.0]).x
    b = minimize(f1, [1.0, 0]).x
    print(
        label,
        len(R),
        y.mean().round(3),
        "two",
        a.round(3),
        f(a).round(4),
        "one",
        b.round(3),
        f1(b).round(4),
    )
    O = lo(np.minimum([r[1] for r in rows], 0.98), 1e-3)
    A = np.array([r[2] for r in rows])
    Y = np.array([r[3] for r in rows])
    G = np.array([r[0] for r in rows])
    q = 1 / (1 + np.exp(-(a[0] * O + a[1] * A + a[2])))
    p = 1 / (1 + np.exp(-(b[0] * O + b[1])))
    m = np.isin(G, ["rendered_val", "sim_val"])
    for t in (0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7):
        print(
            "   ",
            t,
            "two: right %d false %d ground %.2f clutter %.2f tiny r %d f %d"
            % (
                (q >= t)[m & (Y == 1)].sum(),
                (q >= t)[m & (Y == 0)].sum(),
                (q >= t)[G == "ground"].sum() / pics["ground"],
                (q >= t)[G == "clutter"].sum() / pics["clutter"],
                (q >= t)[(G == "tiny2") & (Y == 1)].sum(),
                (q >= t)[(G == "tiny2") & (Y == 0)].sum(),
            ),
        )
    return a


fit(lambda r: True, "all")
fit(lambda r: r[0] != "tiny2" or r[4] % 3 == 0, "third of tiny2")
fit(lambda r: r[0] != "tiny2", "no tiny2")
