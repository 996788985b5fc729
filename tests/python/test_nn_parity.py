"""The C++ networks against torch, on weights files as the exporter writes them."""

import hashlib
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch (the training side) is not installed")
from safetensors.numpy import save_file  # noqa: E402

from intabs import _core  # noqa: E402

torch.set_num_threads(1)
HEADS = {"agent_mean": 7, "env_mean": 12, "b": 1}


class Model(torch.nn.Module):
    """The network of a manifest, in torch."""

    def __init__(
        self, layers, hidden, inputs=40, input_linear=0, residual=False, bidirectional=False, layer_norm=False
    ):
        super().__init__()
        self.spec = dict(
            input=inputs,
            input_linear=input_linear,
            layers=layers,
            hidden=hidden,
            residual=residual,
            bidirectional=bidirectional,
            layer_norm=layer_norm,
            heads=HEADS,
        )
        self.input = torch.nn.Linear(inputs, input_linear) if input_linear else torch.nn.Identity()
        width = hidden * (2 if bidirectional else 1)
        self.lstm = torch.nn.ModuleList(
            torch.nn.LSTM(
                (input_linear or inputs) if k == 0 else width, hidden, batch_first=True, bidirectional=bidirectional
            )
            for k in range(layers)
        )
        self.norm = torch.nn.ModuleList(
            torch.nn.LayerNorm(width) if layer_norm and k > 0 else torch.nn.Identity() for k in range(layers)
        )
        self.heads = torch.nn.ModuleDict({n: torch.nn.Linear(width, size) for n, size in HEADS.items()})
        self.residual = residual
        # Torch's initial weights, tripled: outputs of some size through all the layers, gates that saturate.
        with torch.no_grad():
            for p in self.lstm.parameters():
                p *= 3
            for p in self.norm.parameters():
                p += 0.3 * torch.randn_like(p)

    def forward(self, x, state=None):
        y, new = self.input(x), []
        for k, layer in enumerate(self.lstm):
            out, s = layer(self.norm[k](y), None if state is None else state[k])
            y = out + y if self.residual and k > 0 else out
            new.append(s)
        return y, new

    def tensors(self):
        out = {}
        for name, p in self.named_parameters():
            name = name.replace("_l0", "") if name.startswith("lstm.") else name
            if name.startswith("norm."):  # norm.3.weight -> lstm.3.norm.weight
                _, layer, kind = name.split(".")
                name = f"lstm.{layer}.norm.{kind}"
            out["pi." + name] = p.detach().numpy().copy()
        return out


def write(folder, model, tensors):
    save_file(tensors, folder / "weights.safetensors")
    sha = hashlib.sha256((folder / "weights.safetensors").read_bytes()).hexdigest()
    manifest = {"schema_version": 1, "sha256": sha, "networks": {"pi": model.spec}}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return _core.Network.load(str(folder), "pi")


def worst_difference(model, net, steps=1000, reset_every=270):
    """Largest |difference| over all heads and steps; both are reset in the middle."""
    rng = np.random.default_rng(0)
    X = rng.standard_normal((steps, model.spec["input"])).astype(np.float32)
    state, worst = None, 0.0
    with torch.inference_mode():
        for t in range(steps):
            if t % reset_every == 0:
                state = None
                net.reset()
            y, state = model(torch.from_numpy(X[None, t : t + 1]), state)
            ours = net.step(X[t])
            for name, head in model.heads.items():
                worst = max(worst, np.abs(head(y)[0, 0].numpy() - ours[name]).max())
    return worst


@pytest.mark.parametrize("input_linear", [0, 128])
@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("layers", [1, 3, 8])
def test_step_agrees_with_torch_over_1000_steps_with_resets(tmp_path, layers, residual, input_linear):
    torch.manual_seed(layers)
    model = Model(layers, 128, input_linear=input_linear, residual=residual)
    assert worst_difference(model, write(tmp_path, model, model.tensors())) <= 1e-5


def test_two_swapped_gates_are_noticed(tmp_path):
    torch.manual_seed(1)
    model = Model(3, 64, residual=True)
    tensors = model.tensors()
    for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        a = tensors[f"pi.lstm.1.{part}"]
        i, f, g, o = np.split(a.copy(), 4)
        a[:] = np.concatenate([f, i, g, o])
    assert worst_difference(model, write(tmp_path, model, tensors), steps=50) > 1e-2


def test_layer_norm_agrees_with_torch(tmp_path):
    torch.manual_seed(3)
    model = Model(3, 64, input_linear=64, residual=True, layer_norm=True)
    assert worst_difference(model, write(tmp_path, model, model.tensors())) <= 1e-5


@pytest.mark.parametrize("bidirectional", [False, True])
@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("layers,hidden", [(1, 48), (3, 64), (8, 128)])
def test_a_whole_trajectory_agrees_with_torch(tmp_path, layers, hidden, residual, bidirectional):
    torch.manual_seed(2)
    model = Model(layers, hidden, residual=residual, bidirectional=bidirectional)
    net = write(tmp_path, model, model.tensors())
    for T in (1, 7, 100):
        X = np.random.default_rng(T).standard_normal((T, 40)).astype(np.float32)
        with torch.inference_mode():
            y, _ = model(torch.from_numpy(X[None]))
            steps = {n: h(y)[0].numpy() for n, h in model.heads.items()}
            ends = torch.cat([y[:, -1, :hidden], y[:, 0, hidden:]], 1)
            final = {n: h(ends)[0].numpy() for n, h in model.heads.items()}
        ours, ours_final = net.sequence(X), net.encode_final(X)
        for n in model.heads:
            assert ours[n].shape == (T, HEADS[n]) and ours[n].dtype == np.float32
            np.testing.assert_allclose(ours[n], steps[n], atol=1e-5, rtol=0)
            np.testing.assert_allclose(ours_final[n], final[n], atol=1e-5, rtol=0)


def test_the_binding_refuses_wrong_shapes_and_says_what_is_wrong(tmp_path):
    import copy

    model = Model(1, 16)
    net = write(tmp_path, model, model.tensors())
    x = np.zeros(40, np.float32)
    with pytest.raises(ValueError, match=r"x must be \(40,\)"):
        net.step(x[:39])
    with pytest.raises(ValueError, match="x is not finite"):
        net.step(np.full(40, np.nan, np.float32))
    with pytest.raises(ValueError, match=r"X must be \(T, 40\)"):
        net.sequence(x)
    with pytest.raises(RuntimeError, match='has no network "eta"; it has pi'):
        _core.Network.load(str(tmp_path), "eta")
    assert net.heads == HEADS
    net.step(x)
    twin, state = copy.copy(net), net.state
    assert state.shape == (2 * 16,) and np.abs(state).max() > 0
    first = net.step(x)["b"]
    assert twin.step(x)["b"] == first
    net.state = state
    assert net.step(x)["b"] == first


def test_double_precision_agrees_with_torch_in_double(tmp_path):
    torch.manual_seed(4)
    for bidirectional in (False, True):
        model = Model(8, 64, residual=True, bidirectional=bidirectional)
        write(tmp_path, model, model.tensors())
        reference = _core.ReferenceNetwork.load(str(tmp_path), "pi")
        X = np.random.default_rng(5).standard_normal((1000, 40))
        model = model.double()
        with torch.inference_mode():
            y, _ = model(torch.from_numpy(X[None]))
            want = {n: head(y)[0].numpy() for n, head in model.heads.items()}
        ours = reference.sequence(X)
        for n in want:
            np.testing.assert_allclose(ours[n], want[n], atol=1e-12, rtol=0)


@pytest.mark.parametrize("isa", _core.instruction_sets())
def test_16_and_8_bit_weights_stay_close_and_cost_less_memory(tmp_path, isa):
    torch.manual_seed(6)
    model = Model(8, 128, residual=True)
    write(tmp_path, model, model.tensors())
    X = np.random.default_rng(7).standard_normal((200, 40)).astype(np.float32)
    nets = {f: _core.Network.load(str(tmp_path), "pi", format=f, isa=isa) for f in ("fp32", "16", "8")}
    want = _core.ReferenceNetwork.load(str(tmp_path), "pi").sequence(X)["agent_mean"]
    scale = np.abs(want).max()
    for f, bound in (("fp32", 1e-5), ("16", 0.05), ("8", 0.05)):
        got = np.stack([nets[f].step(x)["agent_mean"] for x in X])
        assert np.abs(got - want).max() <= bound * scale, f
    assert nets["16"].weight_bytes < 0.53 * nets["fp32"].weight_bytes
    assert nets["8"].weight_bytes < 0.30 * nets["fp32"].weight_bytes


def test_a_batch_is_many_networks_and_gives_views_of_its_own_memory(tmp_path):
    torch.manual_seed(8)
    model = Model(3, 64, residual=True)
    net = write(tmp_path, model, model.tensors())
    batch = _core.NetworkBatch(net, 5)
    assert len(batch) == 5
    X = np.random.default_rng(9).standard_normal((10, 5, 40)).astype(np.float32)
    steps = [{n: v.copy() for n, v in batch.step(x).items()} for x in X]
    for j in range(5):
        net.reset()
        for t in range(10):
            for n, v in net.step(X[t, j]).items():
                np.testing.assert_allclose(steps[t][n][j], v, atol=1e-6)
        np.testing.assert_allclose(batch.state(j), net.state, atol=1e-6)
    view = batch.step(X[0])["env_mean"]
    before = view.copy()
    batch.step(X[1])
    assert view.shape == (5, 12) and not view.flags.writeable and np.abs(view - before).max() > 0
    outputs = net.outputs["b"]
    del net
    assert np.isfinite(outputs).all()  # the view keeps the network alive
    batch.set_state(0, batch.state(4))
    np.testing.assert_array_equal(batch.state(0), batch.state(4))
    with pytest.raises(IndexError, match="rollout 5 of 5"):
        batch.state(5)
    with pytest.raises(ValueError, match=r"X must be \(5, 40\)"):
        batch.step(X[0, :4])


def test_long_calls_release_the_gil(tmp_path):
    import threading

    model = Model(8, 128, bidirectional=True)
    net = write(tmp_path, model, model.tensors())
    X = np.random.default_rng(1).standard_normal((20000, 40)).astype(np.float32)
    ticks, done = [], threading.Event()

    def count():
        while not done.wait(0.001):
            ticks.append(1)

    thread = threading.Thread(target=count)
    thread.start()
    net.sequence(X)
    during = len(ticks)
    done.set()
    thread.join()
    assert during > 20


@pytest.mark.parametrize("bidirectional, pool", [(False, "last"), (True, "last"), (True, "mean")])
def test_the_networks_of_training_agree_with_their_linear_path(tmp_path, bidirectional, pool):
    from intabs.model.networks import Recurrent

    torch.manual_seed(4)
    model = Recurrent(
        17, 2, 40, HEADS, input_linear=24, residual=True, bidirectional=bidirectional, skip=True, pool=pool
    )
    net = write(tmp_path, model, {f"pi.{k}": v.numpy() for k, v in model.tensors().items()})
    X = np.random.default_rng(1).standard_normal((60, 17)).astype(np.float32)
    with torch.inference_mode():
        want = model(torch.from_numpy(X)[None])
    got = net.encode_final(X) if bidirectional else [net.step(x) for x in X]
    for name in HEADS:
        ours = got[name] if bidirectional else np.stack([row[name] for row in got])
        assert np.abs(want[name][0].numpy() - ours).max() < 1e-5
