import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""fit3.py MODEL.onnx OUT: second looks at the reports of people on the val sets"""
import sys, pickle, json, numpy as np, cv2

cv2.setNumThreads(1)
from pathlib import Path
from sorvolo.detection.session import Session
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import opinions
from sorvolo.detection.contract import SecondLook
from sorvolo.detection.fusing import log_odds

how = SecondLook((60.0,), 1.0, 1.0, 0.0, 0.2, 1000.0, "second-opinion", 2)
first = Session(Path(sys.argv[1]), "cpu", 1)
second = Session(find_model("second-opinion"), "cpu", 1)
sets = {
    **pickle.load(open(STUDENT + "/valsets.pkl", "rb")),
    **pickle.load(open(STUDENT + "/groundval.pkl", "rb")),
}
sets["tiny2"] = [
    (cv2.resize(im, None, fx=2, fy=2), np.asarray(b) * 2.0, l, np.asarray(ig) * 2.0, k)
    for im, b, l, ig, k in sets.pop("tinyperson_val")
]
rows = []
n = {}
for name, pics in sets.items():
    for k, (im, b, l, ig, kn) in enumerate(pics):
        if not kn[0]:
            continue
        im = np.ascontiguousarray(im)
        seen = first.see(im)
        t = np.asarray(b, float).reshape(-1, 4)[np.asarray(l) == 0]
        used = np.zeros(len(t), bool)
        n[name] = n.get(name, 0) + len(t)
        op = opinions(seen, im, second.see, {0: how})
        for i in np.argsort(-seen.scores):
            if seen.labels[i] != 0:
                continue
            B = seen.boxes_px[i].astype(float)
            ar = (B[2:] - B[:2]).prod()

            def inter(t):
                return np.clip(
                    np.minimum(B[2:], t[:, 2:]) - np.maximum(B[:2], t[:, :2]), 0, None
                ).prod(1)

            f = (
                np.where(
                    used,
                    0,
                    inter(t) / np.maximum(ar + (t[:, 2:] - t[:, :2]).prod(1) - inter(t), 1e-9),
                )
                if len(t)
                else np.zeros(0)
            )
            right = len(f) > 0 and f.max() >= 0.5
            if right:
                used[f.argmax()] = True
            else:
                g = np.asarray(ig, float).reshape(-1, 4)
                if len(g) and (inter(g) / ar).max() > 0.5:
                    continue
            if i in op:
                rows.append(
                    (
                        name,
                        float(seen.scores[i]),
                        float(log_odds(op[i], 1e-3).mean()),
                        int(right),
                        k,
                    )
                )
pickle.dump((rows, n, {k: len(v) for k, v in sets.items()}), open(sys.argv[2], "wb"))
print(len(rows), n)
