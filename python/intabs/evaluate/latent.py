"""A map of the skills: every skill of every demonstration as a point, by t-SNE and by principal components of z."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs.data.demos import Demo, name_list
from intabs.errors import UserError
from intabs.evaluate.learned import Learned
from intabs.evaluate.metrics import sample
from intabs.model.space import State

FRAMES = 5  # of a skill, drawn
COLOURS = (
    "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf",
    "#aec7e8", "#ffbb78", "#98df8a", "#ff9896", "#c5b0d5", "#c49c94", "#f7b6d2", "#c7c7c7", "#dbdb8d", "#9edae5",
)  # fmt: skip


@dataclass
class Skills:
    z: np.ndarray  # (n, 16)
    kind: list[str]  # the label that most of its ticks have, or its task
    where: list[str]  # demonstration and ticks
    states: list[State]  # FRAMES of each, (FRAMES, ...)


def skills_of(
    method: Learned, train: list[Demo], demos: list[Demo], names: list[str], label_names: list[str]
) -> Skills:
    """Cut where the learned boundaries are. train: the demonstrations the boundaries' scales come from."""
    out = Skills(np.zeros((0, 16)), [], [], [])
    rows = []
    for demo, name, found in zip(demos, names, method.cuts(train, demos), strict=True):
        s, cuts = sample(demo), found.tolist()
        pieces = list(zip(cuts, cuts[1:], strict=False))
        rows.append(method.encode(method.inputs(s), pieces).numpy())
        task = str(demo.attrs.get("task", ""))
        labels = demo.extra.get("labels") if label_names else None
        for a, b in pieces:
            kind = label_names[np.bincount(labels[a:b]).argmax()] if labels is not None else task
            out.kind.append(kind)
            out.where.append(f"{name}, {task}: frames {a}-{b}")
            out.states.append(s.state[np.linspace(a, b, FRAMES).round().astype(int)])
    out.z = np.concatenate(rows)
    return out


def maps(z: np.ndarray, seed: int = 0) -> dict[str, np.ndarray]:
    """{"t-SNE": (n, 2), "PCA": (n, 2)} of z scaled to unit deviation."""
    from sklearn.decomposition import PCA
    from sklearn.manifold import TSNE

    x = z / np.maximum(z.std(0), 1e-9)
    perplexity = min(30.0, max(2.0, (len(x) - 1) / 4))
    return {
        "t-SNE": TSNE(2, perplexity=perplexity, init="pca", random_state=seed).fit_transform(x),
        "PCA": PCA(2).fit_transform(x),
    }


def picture(skills: Skills, places: dict[str, np.ndarray], out: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    kinds = sorted(set(skills.kind))
    figure, axes = pyplot.subplots(1, len(places), figsize=(7.5 * len(places), 7), constrained_layout=True)
    kind = np.array(skills.kind)
    for ax, (name, xy) in zip(axes, places.items(), strict=True):
        for i, k in enumerate(kinds):
            ax.scatter(*xy[kind == k].T, s=14, color=COLOURS[i % len(COLOURS)], label=f"{k} ({(kind == k).sum()})")
        ax.set_title(f"{name} of z, {len(xy)} skills")
        ax.set_xticks([])
        ax.set_yticks([])
    axes[-1].legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8)
    figure.savefig(out, dpi=120)
    pyplot.close(figure)


def page(skills: Skills, places: dict[str, np.ndarray], title: str) -> str:
    """HTML without anything from elsewhere: a point shows its frames, seen from the side and from above."""
    kinds = sorted(set(skills.kind))
    points = [
        {
            "k": kinds.index(k),
            "w": w,
            "f": _drawing(s),
            **{n: [round(float(v), 2) for v in xy[i]] for n, xy in places.items()},
        }
        for i, (k, w, s) in enumerate(zip(skills.kind, skills.where, skills.states, strict=True))
    ]
    data = json.dumps({"points": points, "kinds": kinds, "maps": list(places), "colours": COLOURS})
    return PAGE.replace("TITLE", html.escape(title)).replace("DATA", data.replace("<", "\\u003c"))


def _drawing(s: State) -> list:
    """For each frame: polyline of the agent and points of the objects, (x, y, z) in mm."""
    frames = []
    for t in range(len(s.agent)):
        line = _agent_line(s.agent[t].numpy())
        objects = [[round(1000 * float(v)) for v in p] for p, seen in zip(s.p[t], s.known[t], strict=True) if seen > 0]
        frames.append([[[round(1000 * float(v)) for v in p] for p in line], objects])
    return frames


def _agent_line(agent: np.ndarray) -> np.ndarray:
    """Places of the Lite 6's joints and tip (8, 3); of a hand its keypoints; of another agent nothing."""
    if len(agent) == 7:
        from intabs import _core

        return _core.ArmModel.lite6().places(agent[:6])
    if len(agent) % 3 == 0 and len(agent) >= 63:
        return agent[:63].reshape(21, 3)
    return np.zeros((0, 3))


def latent(run: Path, data: Path, out: Path, progress: Callable[[int, str], None] = lambda done, text: None) -> dict:
    from intabs.data.reader import DemoFile
    from intabs.evaluate.evaluate import find_sources, load_learned

    if out.suffix not in (".png", ".html"):
        raise UserError(f"--out {out}: must end in .png or .html")
    method = load_learned(find_sources([run])[0])
    with DemoFile(data) as f:
        names, demos = list(f.names), [f.demo(k) for k in range(len(f))]
        label_names = name_list(f.attrs.get("label_names"))
        train = set(f.masks().get("train", names))
    progress(1, "encode")
    in_training = [d for d, n in zip(demos, names, strict=True) if n in train]
    skills = skills_of(method, in_training or demos, demos, names, label_names)
    progress(2, f"{len(skills.z)} skills: t-SNE")
    places = maps(skills.z)
    progress(3, "draw")
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".png":
        picture(skills, places, out)
    else:
        out.write_text(page(skills, places, f"Skills of {data.name}, {method.name}"))
    return {"skills": len(skills.z), "kinds": len(set(skills.kind)), "demos": len(demos)}


PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>TITLE</title><style>
body{font:14px system-ui,sans-serif;margin:1em;color:#222}main{display:flex;flex-wrap:wrap;gap:1em}
#map{flex:1 1 560px;max-width:820px;border:1px solid #ddd}#side{flex:1 1 420px}circle{cursor:pointer}
circle.on{stroke:#000;stroke-width:2}.key span{display:inline-block;margin-right:.8em;cursor:pointer}
.key i{display:inline-block;width:.8em;height:.8em;border-radius:50%;margin-right:.3em}.off{opacity:.25}
.shots svg{width:100%;border:1px solid #eee;margin-bottom:.4em}</style>
<h1>TITLE</h1><p>A point is a skill, its colour what it is; point at it to see its frames.
Map: <select id="which"></select></p><div class="key" id="key"></div>
<main><svg id="map" viewBox="-10 -10 820 620"></svg><div id="side"><p id="what"></p><div class="shots" id="shots"></div>
</div></main><script>
const D=DATA,S='http://www.w3.org/2000/svg',hidden=new Set();
const el=(n,a,p)=>{const e=document.createElementNS(S,n);for(const k in a)e.setAttribute(k,a[k]);p.appendChild(e);
 return e};
const which=document.getElementById('which'),map=document.getElementById('map'),key=document.getElementById('key');
D.maps.forEach(m=>{const o=document.createElement('option');o.textContent=m;which.appendChild(o)});
D.kinds.forEach((k,i)=>{const s=document.createElement('span');
 s.innerHTML='<i style="background:'+D.colours[i%20]+'"></i>';s.append(k);
 s.onclick=()=>{hidden.has(i)?hidden.delete(i):hidden.add(i);s.classList.toggle('off');draw()};key.appendChild(s)});
function box(points){const r=[1e9,1e9,-1e9,-1e9];points.forEach(([x,y])=>{r[0]=Math.min(r[0],x);r[1]=Math.min(r[1],y);
 r[2]=Math.max(r[2],x);r[3]=Math.max(r[3],y)});return r}
function draw(){map.replaceChildren();const m=which.value,r=box(D.points.map(p=>p[m]));
 D.points.forEach(p=>{if(hidden.has(p.k))return;const [x,y]=p[m];
  const c=el('circle',{cx:(x-r[0])/(r[2]-r[0]||1)*800,cy:600-(y-r[1])/(r[3]-r[1]||1)*600,r:5,fill:D.colours[p.k%20],
   'fill-opacity':.8},map);c.onmouseenter=c.onclick=()=>show(p,c)})}
function show(p,c){map.querySelectorAll('.on').forEach(e=>e.classList.remove('on'));c.classList.add('on');
 document.getElementById('what').textContent=D.kinds[p.k]+': '+p.w;
 const all=p.f.flatMap(f=>f[0].concat(f[1])),shots=document.getElementById('shots');shots.replaceChildren();
 if(!all.length)return;
 for(const [say,u,v] of [['from the side (x, z)',0,2],['from above (x, y)',0,1]]){
  const r=box(all.map(q=>[q[u],q[v]])),k=Math.max(r[2]-r[0],r[3]-r[1],60),W=190;
  const g=el('svg',{viewBox:'0 0 '+W*p.f.length+' '+(W+14)},shots);
  const t=el('text',{x:4,y:11,'font-size':11},g);t.textContent=say+', '+Math.round(k)+' mm';
  p.f.forEach((f,i)=>{const X=q=>i*W+8+(q[u]-r[0])/k*(W-16),Y=q=>W+6-(q[v]-r[1])/k*(W-16);
   el('polyline',{points:f[0].map(q=>X(q)+','+Y(q)).join(' '),fill:'none',stroke:'#444','stroke-width':3},g);
   f[1].forEach((q,j)=>el('circle',{cx:X(q),cy:Y(q),r:6,fill:D.colours[j]},g))})}}
which.onchange=draw;draw();</script></html>
"""
