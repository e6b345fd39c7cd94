"""Makes the files of this folder with the implementations' own code.

    python make.py rcwm-authors    FOLDER_OF_THEIR_REPOSITORY rcwm-authors
    python make.py dreamerv3-torch FOLDER_OF_THEIR_REPOSITORY dreamerv3-torch

Writes OUT.pt, a small model with random weights as their torch.save writes it, and OUT.safetensors, what their model makes of 50
observations with the most probable classes. Needs torch, numpy, ruamel.yaml and what their modules import.
"""

import json
import sys
import types
from pathlib import Path

import numpy as np
import torch
from ruamel.yaml import YAML

kind, repository, out = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
AUTHORS = kind == "rcwm-authors"
sys.path[:0] = [str(repository), str(repository / "rcwm")]
import models  # noqa: E402

STEPS, PICTURE = 50, 25


def settings():
    defaults = YAML(typ="safe").load((repository / "configs.yaml").read_text())["defaults"]
    for key, value in defaults.items():
        if isinstance(value, str):  # 1e-4 is text in YAML
            try:
                defaults[key] = float(value)
            except ValueError:
                pass
    config = types.SimpleNamespace(**defaults)
    config.device, config.num_actions, config.compile = "cpu", 4, False
    config.dyn_hidden = config.dyn_deter = 24
    config.dyn_stoch, config.dyn_discrete, config.units = 4, 8, 20
    for part in (config.encoder, config.decoder):
        part.update(cnn_depth=4, mlp_keys="$^", cnn_keys="image")
    return config


class Agent(torch.nn.Module):
    def __init__(self, config):
        super().__init__()
        image = types.SimpleNamespace(shape=(64, 64, 3))
        space = types.SimpleNamespace(spaces={"image": image})
        world = models.RoboCentricWorldModel if AUTHORS else models.WorldModel
        self._wm = world(space, None, 0, config)
        self._task_behavior = models.ImagBehavior(config, self._wm)
        self._expl_behavior = self._task_behavior


def randomise(agent):
    """Away from zeros and ones, so that no part is without effect."""
    with torch.no_grad():
        for name, weight in agent.named_parameters():
            gain = weight.ndim == 1 and name.endswith("weight")
            weight.copy_(1 + 0.1 * torch.randn_like(weight) if gain else weight + 0.15 * torch.randn_like(weight))
        value = agent._task_behavior.value.state_dict()
        agent._task_behavior._slow_value.load_state_dict({key: x + 0.01 for key, x in value.items()})


def observations():
    t, y, x, c = np.ogrid[:STEPS, :64, :64, :3]
    image = ((t * 7 + y * 3 + x * 5 + c * 40) % 256).astype(np.uint8)
    # Actions beyond 1 are divided back by the authors' code and by ours, not by dreamerv3-torch.
    size = 1.2 if AUTHORS else 0.95
    action = np.stack([np.sin(0.37 * np.arange(STEPS) * (k + 1) + k) for k in range(4)], -1) * size
    action[0] = 0
    first = np.isin(np.arange(STEPS), (0, 30)).astype(np.float32)
    return torch.tensor(image).float() / 255 - (0.5 if AUTHORS else 0), action.astype(np.float32), first


@torch.no_grad()
def run(agent):
    image, action, first = observations()
    world, behaviour = agent._wm, agent._task_behavior
    dynamics = world.dynamics
    embed = world.encoder({"image": image})
    rows = []
    state = dynamics.initial(1) if AUTHORS else None
    for step in range(STEPS):
        act, begins = torch.tensor(action[step : step + 1]), torch.tensor(first[step : step + 1])
        if AUTHORS:
            here = [part[step : step + 1] for part in embed]
            robot, environment, _, _ = dynamics.obs_step(state, act, *here, begins, sample=False)
            state = (robot, environment)
            features = torch.cat([dynamics.get_feat(part) for part in state], -1)
            row = {"robot_h": robot["deter"], "robot_logits": robot["logit"]}
            row |= {"environment_h": environment["deter"], "environment_logits": environment["logit"]}
        else:
            before = None if state is None else act
            state, _ = dynamics.obs_step(state, before, embed[step : step + 1], begins, sample=False)
            features = dynamics.get_feat(state)
            row = {"h": state["deter"], "logits": state["logit"]}
        row["action"] = behaviour.actor(features).mode()
        row["reward"] = world.heads["reward"](features).mode()
        row["continue"] = world.heads["cont"](features).mean
        row["value"] = behaviour.value(features).mode()
        rows.append({name: x.reshape(-1).numpy() for name, x in row.items()})
        if step == PICTURE and AUTHORS:
            parts = [dynamics.get_feat(part)[None] for part in state]
            _, of_robot, of_environment, _, _ = world.heads["decoder"](*parts)
            picture = of_robot + of_environment
        elif step == PICTURE:
            picture = world.heads["decoder"](features[None])["image"].mode() - 0.5
    values = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return values | {"actions": action, "picture": picture.reshape(64, 64, 3).numpy()}


def write(values):
    header, blob = {}, b""
    for name in sorted(values):
        data = np.ascontiguousarray(values[name], "<f4")
        header[name] = {"dtype": "F32", "shape": data.shape, "data_offsets": [len(blob), len(blob) + data.nbytes]}
        blob += data.tobytes()
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    Path(f"{out}.safetensors").write_bytes(len(text).to_bytes(8, "little") + text + blob)


torch.manual_seed(3)
agent = Agent(settings())
randomise(agent)
torch.save({"agent_state_dict": agent.state_dict(), "optims_state_dict": {}}, f"{out}.pt")
write(run(agent))
