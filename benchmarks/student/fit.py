import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import pickle, json, numpy as np, sys

sys.path.insert(0, MODELS)
from sorvolo.detection.fusing import platt_fit, platt_scaled

pairs = pickle.load(open(STUDENT + "/pairs.pkl", "rb"))
N = ["person", "car", "small object"]
for c in (0, 1):
    p = [x for x in pairs[c] if x[0] >= 0.02]
    s = np.array([x[0] for x in p])
    r = np.array([x[1] for x in p], bool)
    f = platt_fit(s, r)
    q = platt_scaled(s, f)
    best = max(
        (2 * (r[q >= t]).sum() / ((q >= t).sum() + r.sum()), t) for t in np.arange(0.1, 0.9, 0.02)
    )
    print(
        N[c],
        len(s),
        r.mean().round(3),
        f,
        "best F1",
        best,
        "reliab",
        [
            (
                round(a, 1),
                int(((q >= a) & (q < a + 0.1)).sum()),
                round(float(r[(q >= a) & (q < a + 0.1)].mean()), 2)
                if ((q >= a) & (q < a + 0.1)).any()
                else None,
            )
            for a in np.arange(0, 1, 0.1)
        ],
    )
    for name in sorted({x[2] for x in p}):
        m = np.array([x[2] == name for x in p])
        print(
            "   ",
            name,
            [
                (
                    round(a, 1),
                    int((m & (q >= a) & (q < a + 0.2)).sum()),
                    round(float(r[m & (q >= a) & (q < a + 0.2)].mean()), 2)
                    if (m & (q >= a) & (q < a + 0.2)).any()
                    else None,
                )
                for a in np.arange(0, 1, 0.2)
            ],
        )
