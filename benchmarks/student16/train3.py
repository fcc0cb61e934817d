import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""train.py OUT --init day|FILE --steps N --batch 8 ... resumable"""
import argparse, glob, pickle, os, time, json, threading, queue, math, sys
from copy import deepcopy
from pathlib import Path
import numpy as np, cv2, torch
from torch import nn
from torch.nn import functional as F

sys.path.insert(0, STUDENT)
cv2.setNumThreads(1)
import student as S
from sorvolo.lab.training.nanodet import cells, boxes_from_bins, BINS, FinerNanoDetHead

p = argparse.ArgumentParser()
p.add_argument("out", type=Path)
p.add_argument("--init", default="day")
p.add_argument("--steps", type=int, default=4000)
p.add_argument("--batch", type=int, default=8)
p.add_argument("--rate", type=float, default=6e-4)
p.add_argument("--backbone", type=float, default=0.4)
p.add_argument("--pools", nargs="+", default=[STUDENT + "/pool"])
p.add_argument("--seconds", type=float, default=0)
p.add_argument("--threads", type=int, default=1)
p.add_argument("--hard", type=float, default=0.35)
p.add_argument("--side", type=int, default=384)
a = p.parse_args()
torch.set_num_threads(a.threads)
torch.manual_seed(3)
a.out.mkdir(parents=True, exist_ok=True)
torch.set_flush_denormal(True)
net = getattr(S, a.init)() if a.init in ("day", "thermal") else None
if net is None:
    net = S.Net(S.NanoDetBackbone(), FinerNanoDetHead(3))
    net.load_state_dict({k: v.float() for k, v in torch.load(a.init, weights_only=True).items()})
net = net.to(memory_format=torch.channels_last).train()
avg = deepcopy(net).eval()
groups = [
    {"params": list(net.backbone.parameters()), "share": a.backbone},
    {"params": list(net.head.parameters()), "share": 1.0},
]
opt = torch.optim.AdamW(groups, a.rate, weight_decay=0.02)
step0 = 0
used0 = 0.0
ck = a.out / "checkpoint.pt"
if ck.exists():
    c = torch.load(ck, weights_only=True)
    net.load_state_dict(c["net"])
    avg.load_state_dict(c["avg"])
    opt.load_state_dict(c["opt"])
    step0 = c["step"]
    used0 = c["used"]
    print("resume", step0, flush=True)
cache = {}


def files():
    return sorted(f for d in a.pools for f in glob.glob(d + "/*.pkl"))


def load(f):
    if f not in cache:
        cache[f] = pickle.load(open(f, "rb"))
    return cache[f]


M = 40


def fill(v, e=0):
    o = np.full((M, *v.shape[1:]), e, np.float32 if v.ndim > 1 else np.int64)
    k = min(len(v), M)
    o[:k] = v[:k]
    return o


def augment(im, b, l, ig, rng):
    k = int(rng.integers(4)) if True else 0
    s = a.side
    # zoom: scale-mosaic of one: shrink into a corner tile of four is done by batch mosaics below
    if rng.random() < 0.5:
        im = im[:, ::-1]
    else:
        return im, b, l, ig
    b = b.copy()
    ig = ig.copy()
    for x in (b, ig):
        if len(x):
            x[:, [0, 2]] = s - x[:, [2, 0]]
    return im, b, l, ig


def decode(t):
    im = cv2.imdecode(np.frombuffer(t[0], np.uint8), 1)[..., ::-1]
    return im, t[1].reshape(-1, 4), t[2], t[3].reshape(-1, 4), t[4].astype(np.float32)


def tone(im, rng):
    x = im.astype(np.float32)
    x *= rng.uniform(0.88, 1.14, 3).astype(np.float32)
    x = (x - x.mean()) * rng.uniform(0.7, 1.3) + x.mean() + rng.uniform(-30, 30)
    return np.clip(x, 0, 255).astype(np.uint8)


PRI = {}
NADIR = {
    "caliterra",
    "fixed_wing",
    "painted",
    "aerial_cars",
    "mannequin",
    "mined",
    "mined-labelled",
    "simulated",
    "ground",
}


def one(rng):
    fs = files()
    if len(PRI) > 300 and rng.random() < a.hard:
        keys = list(PRI)
        f, i = max(
            (keys[int(k)] for k in rng.integers(len(keys), size=5)), key=lambda k: PRI.get(k, 0)
        )
    else:
        f = fs[int(rng.integers(len(fs)))]
        i = int(rng.integers(len(load(f))))
    t = load(f)[i]
    im, b, l, ig, k = decode(t)
    if t[5] in NADIR:
        for _ in range(int(rng.integers(4))):
            im = np.rot90(im)
            b, ig = (
                np.stack([x[:, 1], a.side - x[:, 2], x[:, 3], a.side - x[:, 0]], 1) if len(x) else x
                for x in (b, ig)
            )
    one.last = (f, i) if t[5] not in ("tinyperson", "hituav", "aerial_cars") else None
    return im, b, l, ig, k


def drawn(rng):
    if rng.random() < 0.15:  # scale mosaic: four samples at half size
        s = a.side
        h = s // 2
        im = np.zeros((s, s, 3), np.uint8)
        B, L, I = [], [], []
        K = np.ones(3, np.float32)
        for y in (0, h):
            for x in (0, h):
                i, b, l, ig, k = one(rng)
                im[y : y + h, x : x + h] = cv2.resize(i, (h, h), interpolation=cv2.INTER_AREA)
                b = b / 2
                small = (b[:, 2:] - b[:, :2]).max(1, initial=0) < 5
                K *= k
                B.append(b[~small] + [x, y, x, y])
                L.append(l[~small])
                I += [ig / 2 + [x, y, x, y], b[small] + [x, y, x, y]]
        r = (im, np.vstack(B), np.concatenate(L), np.vstack(I), K)
    else:
        r = one(rng)
        key = one.last
        return (*drawn2(r, rng), key)
    return (*drawn2(r, rng), None)


def drawn2(r, rng):
    im, b, l, ig, k = r
    im, b, l, ig = augment(im, b, l, ig, rng)
    return tone(im, rng), b, l, ig, k


Q = queue.Queue(6)


def feed(seed):
    rng = np.random.default_rng((11, seed, step0))
    while True:
        rows = [drawn(rng) for _ in range(a.batch)]
        Q.put(
            (
                torch.from_numpy(
                    np.stack([np.ascontiguousarray(r[0].transpose(2, 0, 1)) for r in rows])
                ),
                *(
                    torch.from_numpy(np.stack(c))
                    for c in (
                        [fill(r[1].astype(np.float32)) for r in rows],
                        [fill(r[2], -1) for r in rows],
                        [fill(r[3].astype(np.float32)) for r in rows],
                        [r[4] for r in rows],
                    )
                ),
                [r[5] for r in rows],
            )
        )


threading.Thread(target=feed, args=(0,), daemon=True).start()


def sides(lo, hi):
    return (hi - lo).clamp(min=0).prod(-1)


def assigned(places, boxes, labels, ignored):
    real = labels >= 0
    count, things = real.shape
    centre = (boxes[..., :2] + boxes[..., 2:]) / 2
    near, first = [], 0
    around = torch.arange(-1, 2)
    for st in FinerNanoDetHead.strides:
        w = a.side // st
        mid = (centre / st).floor().long().clamp(1, w - 2)
        c, r = (mid[..., ax, None] + around for ax in (0, 1))
        near.append((first + r[..., :, None] * w + c[..., None, :]).flatten(2))
        first += w * w
    cell = torch.cat(near, 2)
    place, box = places[cell], boxes[:, :, None]
    half = 2.5 * place[..., 2:]
    lo, hi = place[..., :2] - half, place[..., :2] + half
    inner = sides(torch.maximum(lo, box[..., :2]), torch.minimum(hi, box[..., 2:]))
    ov = inner / (sides(lo, hi) + sides(box[..., :2], box[..., 2:]) - inner).clamp(min=1e-6)
    inside = ((place[..., :2] > box[..., :2]) & (place[..., :2] < box[..., 2:])).all(-1)
    fits = (ov >= ov.mean(2, keepdim=True) + ov.std(2, keepdim=True)) & inside & real[..., None]
    away = ((place[..., :2] - centre[:, :, None]) ** 2).sum(-1) + (place[..., 2] > 4) * 1e6
    fits |= (~fits.any(2) & real)[..., None] & (away == away.amin(2, keepdim=True))
    cell, worth = cell.flatten(1), torch.where(fits, ov + 1e-4, 0.0).flatten(1)
    best = torch.zeros(count, len(places)).scatter_reduce_(1, cell, worth, "amax")
    wins = (worth > 0) & (worth >= best.gather(1, cell))
    owner = torch.full((count, len(places) + 1), -1)
    thing = torch.arange(things)[None, :, None].expand_as(fits).flatten(1)
    owner.scatter_(1, torch.where(wins, cell, len(places)), thing)
    owner = owner[:, :-1]
    for reg in ignored.unbind(1):
        if not (reg[:, 2] > reg[:, 0]).any():
            continue
        held = ((places[:, :2] > reg[:, None, :2]) & (places[:, :2] < reg[:, None, 2:])).all(-1)
        owner[held & (owner < 0)] = -2
    return owner


NEG = []


def losses(outs, boxes_, labels, ignored, known):
    scores, bins, places = cells([o.float() for o in outs], FinerNanoDetHead.strides, 3)
    with torch.no_grad():
        owner = assigned(places, boxes_, labels, ignored)
    row, cell = torch.nonzero(owner >= 0, as_tuple=True)
    goal, label = boxes_[row, owner[row, cell]], labels[row, owner[row, cell]]
    own, place = bins[row, cell], places[cell]
    bx = boxes_from_bins(own, place)
    inner = sides(torch.maximum(bx[:, :2], goal[:, :2]), torch.minimum(bx[:, 2:], goal[:, 2:]))
    outer = sides(
        torch.minimum(bx[:, :2], goal[:, :2]), torch.maximum(bx[:, 2:], goal[:, 2:])
    ).clamp(min=1e-6)
    union = (sides(bx[:, :2], bx[:, 2:]) + sides(goal[:, :2], goal[:, 2:]) - inner).clamp(min=1e-6)
    ov = inner / union
    target = torch.zeros_like(scores)
    target[row, cell, label] = ov.detach()
    ch = scores.detach().sigmoid()
    each = F.binary_cross_entropy_with_logits(scores, target, reduction="none")
    w = (owner > -2).float()[..., None] * known[:, None]
    w[row, cell, label] = 1.0
    focal = (w * (target - ch) ** 2 * each).sum() / max(len(row), 1)
    with torch.no_grad():
        neg = w * (target - ch) ** 2 * each
        neg = neg.clone()
        neg[row, cell] = 0
        NEG[:] = neg.amax((1, 2)).tolist()
    share = ch[row, cell, label]
    reach = (
        torch.cat([place[:, :2] - goal[:, :2], goal[:, 2:] - place[:, :2]], 1) / place[:, 2:]
    ).clamp(0, BINS - 1.01)
    below = reach.floor().long()
    odds = own.log_softmax(-1)
    lower, upper = (odds.gather(-1, e[..., None])[..., 0] for e in (below, below + 1))
    binned = -(lower * (1 - reach + below) + upper * (reach - below)).mean(1)
    total = share.sum().clamp(min=1e-3)
    return (
        focal,
        ((1 - ov + (outer - union) / outer) * share).sum() / total,
        (binned * share).sum() / total,
    )


def save():
    torch.save(
        {
            "net": net.state_dict(),
            "avg": avg.state_dict(),
            "opt": opt.state_dict(),
            "step": step,
            "used": used,
        },
        ck.with_suffix(".tmp"),
    )
    os.replace(ck.with_suffix(".tmp"), ck)
    torch.save({k: v.half() for k, v in avg.state_dict().items()}, a.out / "avg.tmp")
    os.replace(a.out / "avg.tmp", a.out / "avg.pt")


step = step0
used = used0
t0 = time.monotonic()
c0 = time.process_time()
rec = []
while True:
    done = step / a.steps if not a.seconds else min(1, (used0 + time.monotonic() - t0) / a.seconds)
    if done >= 1:
        break
    im, b, l, ig, k, keys = Q.get()
    with torch.autocast("cpu", torch.bfloat16):
        outs = net(im.float().contiguous(memory_format=torch.channels_last))
    f, bo, bi = losses(outs, b, l, ig, k)
    fall = 0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * done))
    for g in opt.param_groups:
        g["lr"] = a.rate * g["share"] * min((step + 1) / 150, fall)
    opt.zero_grad()
    (f + 2 * bo + 0.25 * bi).backward()
    nn.utils.clip_grad_norm_(net.parameters(), 10.0)
    opt.step()
    step += 1
    for key, n in zip(keys, NEG):
        if key:
            PRI[key] = n
    keep = min(0.999, (1 + step) / (10 + step))
    with torch.no_grad():
        for o, n in zip(avg.parameters(), net.parameters()):
            o.lerp_(n, 1 - keep)
    rec.append([float(f.detach()), float(bo.detach()), float(bi.detach())])
    used = used0 + time.monotonic() - t0
    if step % 25 == 0:
        print(
            json.dumps(
                {
                    "step": step,
                    "done": round(done, 4),
                    "loss": [round(x, 4) for x in np.mean(rec, 0)],
                    "s": round(used),
                    "cpu": round(time.process_time() - c0),
                    "shards": len(files()),
                }
            ),
            flush=True,
        )
        rec = []
    if step % 250 == 0:
        save()
save()
print("finished", step)
