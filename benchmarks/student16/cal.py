import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import pickle, sys, json, numpy as np
from sorvolo.detection.fusing import platt_fit, platt_scaled

pairs, n, pics = pickle.load(open(sys.argv[1], "rb"))
out = {"calibration": {}, "thresholds": {"small object": 0.4}}
for c, name in ((0, "person"), (1, "car")):
    p = [
        x
        for k, x in enumerate(pairs[c])
        if x[0] >= 0.02 and (x[2] != "tiny2" or (c == 0 and k % 6 == 0))
    ]
    s = np.array([x[0] for x in p])
    r = np.array([x[1] for x in p], bool)
    f = platt_fit(s, r)
    q = platt_scaled(s, f)
    g = np.array([x[2] for x in p])
    print(name, len(s), r.sum(), f)
    N = sum(v for (nm, cc), v in n.items() if cc == c and not (nm == "tiny2"))
    main = np.isin(g, ["rendered_val", "sim_val"])
    for t in np.arange(0.2, 0.9, 0.05):
        tp = (r & main & (q >= t)).sum()
        fp = (~r & main & (q >= t)).sum()
        print(
            "  %.2f recall %.2f precision %.2f F1 %.2f ground %.2f clutter %.2f share right of [t,t+.1) %s"
            % (
                t,
                tp / N,
                tp / max(1, tp + fp),
                2 * tp / (N + tp + fp),
                ((g == "ground") & ~r & (q >= t)).sum() / pics["ground"],
                ((g == "clutter") & ~r & (q >= t)).sum() / pics["clutter"],
                round(float(r[(q >= t) & (q < t + 0.1)].mean()), 2)
                if ((q >= t) & (q < t + 0.1)).any()
                else None,
            )
        )
    out["calibration"][name] = {"slope": round(f.slope, 3), "shift": round(f.shift, 3)}
json.dump(out, open(sys.argv[2], "w"))
