import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import sys, pickle, numpy as np, cv2

cv2.setNumThreads(1)
from sorvolo.detection.detector import Detector

d = Detector.load("default", provider="cpu", threads=1)
sets = {
    **pickle.load(open(STUDENT + "/valsets.pkl", "rb")),
    **pickle.load(open(STUDENT + "/groundval.pkl", "rb")),
}
sets.pop("tinyperson_val")
step = {"ground": 2, "rendered_val": 3, "sim_val": 2, "clutter": 3}


def inter(B, t):
    return np.clip(np.minimum(B[2:], t[:, 2:]) - np.maximum(B[:2], t[:, :2]), 0, None).prod(1)


rows = []
n = {}
k = 0
part = int(sys.argv[1])
for name, pics in sets.items():
    for im, b, l, ig, kn in pics[:: step[name]]:
        k += 1
        if k % 2 != part:
            continue
        s = d.detect(
            np.ascontiguousarray(im), tiles="auto", classes=("person", "car"), least_score=0.02
        )
        for c in (0, 1):
            if not kn[c]:
                continue
            t = np.asarray(b, float).reshape(-1, 4)[np.asarray(l) == c]
            n[name, c] = n.get((name, c), 0) + len(t)
            used = np.zeros(len(t), bool)
            for i in np.nonzero(s.labels == c)[0]:
                B = s.boxes_px[i].astype(float)
                ar = (B[2:] - B[:2]).prod()
                f = (
                    np.where(
                        used,
                        0,
                        inter(B, t)
                        / np.maximum(ar + (t[:, 2:] - t[:, :2]).prod(1) - inter(B, t), 1e-9),
                    )
                    if len(t)
                    else np.zeros(0)
                )
                if len(f) and f.max() >= 0.5:
                    used[f.argmax()] = True
                    rows.append((c, float(s.scores[i]), 1, name))
                    continue
                g = np.asarray(ig, float).reshape(-1, 4)
                if len(g) and (inter(B, g) / ar).max() > 0.5:
                    continue
                rows.append((c, float(s.scores[i]), 0, name))
pickle.dump((rows, n), open(STUDENT + f"/pyr{part}.pkl", "wb"))
print(len(rows), n)
