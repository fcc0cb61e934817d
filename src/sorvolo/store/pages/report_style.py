"""The looks of the flight report: one style sheet for light and dark screens and for paper."""

STYLE = """
:root{--paper:#fff;--page:#f3f5f4;--ink:#1d2624;--soft:#5d6b67;--rule:#dfe5e2;--vision:#12805c;
--gps:#d98600;
--rejected:#c2362b;--east:#2660c9;--north:#8c3fc4;--up:#7b8a86;--warn:#fff4dc}
@media (prefers-color-scheme:dark){:root{--paper:#18201e;--page:#0f1513;--ink:#e6edea;--soft:#9aaaa5;
--rule:#2c3734;
--vision:#35b98a;--gps:#f0a835;--rejected:#ef6a5e;--east:#6fa0ff;--north:#c68af0;--up:#a3b1ad;
--warn:#382d12}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",
Roboto,sans-serif}
main{max-width:1000px;margin:0 auto;padding:32px 20px 64px}
h1{font-size:1.75rem;line-height:1.25;margin:.2em 0 .4em;text-wrap:balance}
h2{font-size:1.15rem;margin:0 0 .7em}section h2:not(:first-child){margin-top:2em}
h3{font-size:.95rem;margin:1.6em 0 .4em}
.over,.note,figcaption{color:var(--soft);font-size:.9rem}
.over{margin:0}
section{background:var(--paper);border:1px solid var(--rule);border-radius:12px;padding:22px 24px;
margin:20px 0}
.warn{background:var(--warn);border-color:var(--gps)}.warn ul{margin:0;padding-left:1.2em}
figure{margin:24px 0}figcaption{margin-top:8px}
.frame{position:relative;background:#ececec;border-radius:12px;overflow:hidden;border:1px solid var(--rule)}
.frame img{display:block;width:100%;height:auto}
.scale{position:absolute;left:14px;bottom:12px;border:solid #111;border-width:0 2px 3px;color:#111;
text-align:center;
font-size:.8rem;font-weight:600;line-height:1.5;text-shadow:0 0 3px #fff,0 0 3px #fff,0 0 3px #fff;
filter:drop-shadow(0 0 1px #fff)}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(200px,45%),1fr));gap:12px;margin:20px 0}
.figures div{background:var(--paper);border:1px solid var(--rule);border-radius:12px;padding:14px 16px}
.figures dt{color:var(--soft);font-size:.8rem;text-transform:uppercase;letter-spacing:.05em}
.figures dd{margin:2px 0;font-size:1.5rem;font-weight:650;font-variant-numeric:tabular-nums}
.figures p{margin:0;color:var(--soft);font-size:.82rem;line-height:1.35}
.shares{display:flex;height:16px;border-radius:8px;overflow:hidden;margin-bottom:14px;
background:var(--rule)}
.shares .vision{background:var(--vision)}.shares .gps-only{background:var(--gps)}.shares .rejected{
background:var(--rejected)}
.key{display:inline-block;width:11px;height:11px;border-radius:50%;margin:0 6px 0 2px}
.key.vision{background:var(--vision)}.key.gps-only{background:var(--gps);border-radius:2px}
.key.rejected{background:var(--rejected);clip-path:polygon(20% 0,50% 30%,80% 0,100% 20%,70% 50%,100% 80%,
80% 100%,50% 70%,20% 100%,0 80%,30% 50%,0 20%)}
.key.east{background:var(--east)}.key.north{background:var(--north)}.key.up{background:var(--up)}
.wide{overflow-x:auto}.whole{white-space:nowrap}
table{border-collapse:collapse;width:100%;font-size:.92rem}
th{text-align:left;color:var(--soft);font-weight:500;font-size:.82rem}
th,td{padding:6px 14px 6px 0;border-bottom:1px solid var(--rule);vertical-align:top}
tr:last-child td{border-bottom:0}
td{font-variant-numeric:tabular-nums}td:first-child{white-space:nowrap}
.bar{height:12px;background:var(--vision);border-radius:3px;margin-top:6px;min-width:1px}
td:has(.bar){width:50%}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:24px;align-items:start}
svg{display:block;width:100%;height:auto;margin:0 auto}
svg .label{fill:var(--soft);font-size:12px;font-family:inherit}
svg .grid{stroke:var(--rule);fill:none}svg .zero{stroke:var(--soft);fill:none}
svg .ink{stroke:var(--ink);stroke-width:1.5;fill:none}svg .arrow{fill:var(--ink)}
svg .path{stroke:var(--rule);stroke-width:2;fill:none}
svg .tie{stroke:var(--soft);stroke-width:.8;opacity:.7}svg .fix{fill:none;stroke:var(--soft);stroke-width:1}
svg .vision{fill:var(--vision)}svg .gps-only{fill:var(--gps)}
svg .rejected{stroke:var(--rejected);stroke-width:1.8;fill:none}
svg .median{fill:none;stroke:var(--ink);stroke-dasharray:4 4}
svg .line{fill:none;stroke-width:1.5}
svg .east{stroke:var(--east)}svg .north{stroke:var(--north)}svg .up{stroke:var(--up)}
svg .dot{fill:currentColor}
@media print{body{background:#fff}section,.figures div{break-inside:avoid}}
"""
