import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""fit2.py MODEL_IN_DATA: second look by second-opinion on the student's reports of people; prints own, again, shift and calibration after"""
import sys, pickle, json
import numpy as np
from scipy.optimize import minimize
from sorvolo.detection.session import Session, Seen
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import opinions
from sorvolo.detection.contract import SecondLook
from sorvolo.detection.fusing import log_odds

d = json.load(open(MODELS + "default.json"))["second_look"]["person"]
how = SecondLook(tuple(d["looks_px"]), 1.0, 1.0, 0.0, 0.2, d["enlarged"], d["by"], d["positions"])
first = Session(find_model(sys.argv[1]), "cpu", 1)
second = Session(find_model("second-opinion"), "cpu", 1)
rows = []
for name, pics in pickle.load(open(STUDENT + "/valsets.pkl", "rb")).items():
    for im, b, l, ig, kn in pics:
        im = np.ascontiguousarray(im)
        seen = first.see(im)
        t = np.asarray(b, float).reshape(-1, 4)[np.asarray(l) == 0]
        used = np.zeros(len(t), bool)
        op = opinions(seen, im, second.see, {0: how})
        for i in np.argsort(-seen.scores):
            if seen.labels[i] != 0:
                continue
            B = seen.boxes_px[i].astype(float)
            iw = np.clip(np.minimum(B[2], t[:, 2]) - np.maximum(B[0], t[:, 0]), 0, None) * np.clip(
                np.minimum(B[3], t[:, 3]) - np.maximum(B[1], t[:, 1]), 0, None
            )
            ar = (B[2] - B[0]) * (B[3] - B[1])
            ov = (
                iw / np.maximum(ar + (t[:, 2:] - t[:, :2]).prod(1) - iw, 1e-9)
                if len(t)
                else np.zeros(0)
            )
            f = np.where(used, 0, ov)
            right = len(f) > 0 and f.max() >= 0.5
            if right:
                used[f.argmax()] = True
            else:
                g = np.asarray(ig, float).reshape(-1, 4)
                if (
                    len(g)
                    and (
                        np.clip(np.minimum(B[2], g[:, 2]) - np.maximum(B[0], g[:, 0]), 0, None)
                        * np.clip(np.minimum(B[3], g[:, 3]) - np.maximum(B[1], g[:, 1]), 0, None)
                        / ar
                    ).max()
                    > 0.5
                ):
                    continue
            if i in op:
                rows.append(
                    (name, float(seen.scores[i]), float(log_odds(op[i], 1e-3).mean()), int(right))
                )
pickle.dump(rows, open(STUDENT + "/rows2.pkl", "wb"))
own = np.array([log_odds(min(r[1], 0.98), 1e-3) for r in rows]).astype(float)
again = np.array([r[2] for r in rows])
y = np.array([r[3] for r in rows], float)


def loss(w):
    z = w[0] * own + w[1] * again + w[2]
    return np.mean(np.logaddexp(0, z) - y * z) + 1e-3 * (w[0] ** 2 + w[1] ** 2)


def loss1(w):
    z = w[0] * own + w[1]
    return np.mean(np.logaddexp(0, z) - y * z)


a = minimize(loss, [1, 0.5, 0.0]).x
b = minimize(loss1, [1.0, 0]).x
print(len(rows), y.mean(), "two", a.round(3), loss(a), "one", b.round(3), loss1(b))
for nm, z in (("one", b[0] * own + b[1]), ("two", a[0] * own + a[1] * again + a[2])):
    q = 1 / (1 + np.exp(-z))
    print(
        nm,
        [
            (round(t, 2), int(((q >= t) & (y == 1)).sum()), int(((q >= t) & (y == 0)).sum()))
            for t in (0.3, 0.4, 0.5, 0.6, 0.7)
        ],
    )
