"""What users type and find that is wrong, and a phrase of the one sentence that each of it ends with."""

import json

from beliefrl import tasks

TRAIN = "train vrm pendulum-v"
MLP = "train sac-mlp"

MISTAKES = {
    "trian": "did you mean train?",
    "frobnicate": "no command 'frobnicate'",
    "train": "No agent is named",
    "train vmr pendulum-v": "no agent 'vmr': did you mean vrm?",
    "train vrm": "TASK is missing",
    "train vrm pendulm-v": "no task 'pendulm-v': did you mean pendulum-v?",
    f"{TRAIN} extra": "one argument too many, 'extra'",
    f"{TRAIN} --setps 5": "no option --setps: did you mean --steps?",
    f"{TRAIN} --gama=2": "did you mean --gamma?",
    f"{TRAIN} --steps": "--steps needs a value",
    f"{TRAIN} --steps many": "--steps must be a whole number, not 'many'",
    f"{TRAIN} --steps 1.5": "--steps must be a whole number, not '1.5'",
    f"{TRAIN} --steps -5": "steps=-5 is impossible",
    f"{TRAIN} --steps 99999999999999999999": "steps=99999999999999999999 is impossible",
    f"{TRAIN} --seeds 0": "seeds=0 is impossible: it must be a whole number from 1",
    f"{TRAIN} --seeds 99999999999": "seeds=99999999999 is impossible",
    f"{TRAIN} --seed -1": "seed=-1 is impossible",
    f"{TRAIN} --seed 2147483647 --seeds 5": "seed=2147483647 is impossible",
    f"{TRAIN} --eval-every 0": "eval_every=0 is impossible",
    f"{TRAIN} --eval-episodes -2": "eval_episodes=-2 is impossible",
    f"{TRAIN} --gamma 2": "gamma=2.0 is impossible: it must be a number from 0 to 1",
    f"{TRAIN} --gamma x": "--gamma must be a number, not 'x'",
    f"{TRAIN} --tau -1": "tau=-1.0 is impossible",
    f"{TRAIN} --seq-len 0": "seq_len=0 is impossible: it must be a whole number of at least 1",
    f"{TRAIN} --batch-size 0": "batch_size=0 is impossible",
    f"{TRAIN} --d-size 99999999999": "d_size=99999999999 is impossible",
    f"{TRAIN} --lr-actor nan": "lr_actor=nan is impossible",
    f"{TRAIN} --lr-actor -1": "lr_actor=-1.0 is impossible",
    f"{TRAIN} --actor-regulariser inf": "actor_regulariser=inf is impossible",
    f"{TRAIN} --policy-layers 0": "policy_layers=(0,) is impossible",
    f"{TRAIN} --policy-layers": "policy_layers=() is impossible",
    "train slac pendulum-v --history 0": "history=0 is impossible",
    "train sac-lstm pendulum-v --burn-in -1": "burn_in=-1 is impossible",
    "train sac-mlp pendulum-v --seq-len 4": "There is no option --seq-len",
    f"{TRAIN} --models three": "--models must be one of 'both', 'single', 'first', 'keep', not 'three'",
    f"{TRAIN} --elbo-scaling foo": "--elbo-scaling must be one of 'mean', 'sum', not 'foo'",
    f"{TRAIN} --train-interval-rl 3": "train_interval_klvrm=5 is not a multiple of train_interval_rl=3",
    f"{TRAIN} --replay-capacity 10": "replay_capacity=10 is too small: this agent needs at least 2000",
    f"{TRAIN} --out there": "there exists already",
    f"{TRAIN} --out there/file/run": "there/file/run cannot be made",
    "evaluate": "RUN is missing",
    "evaluate missing": "no run folder missing",
    "evaluate there": "there is not a run",
    "evaluate broken": "broken/config.json cannot be read",
    "evaluate empty": "empty/config.json lacks",
    "evaluate untrained": "untrained has no trained agent yet",
    "evaluate damaged": "damaged/agent.safetensors is damaged",
    "evaluate foreign": "no agent 'foreign'",
    "evaluate untrained --episodes 0": "episodes=0 is impossible",
    "evaluate untrained --episodes 999999999999": "episodes=999999999999 is impossible",
    "evaluate untrained --seed -1": "seed=-1 is impossible",
    "evaluate untrained --episdes 2": "did you mean --episodes?",
    "export": "RUN is missing",
    "export missing policy.jax": "no run folder missing",
    "export untrained policy.jax": "untrained has no trained agent yet",
    "export untrained policy.jax --seed 3": "untrained has no seed 3: it has 0",
    "tasks all": "one argument too many, 'all'",
    "bench": "No agent is named",
    "bench vrm --obs 0": "obs_dim=0 is impossible",
    "bench vrm --actions -1": "action_dim=-1 is impossible",
    "bench vrm --seeds 0": "seeds=0 is impossible",
    f"{TRAIN} --checkpoint-steps -1": "checkpoint_steps=-1 is impossible",
    f"{TRAIN} --checkpoint-minutes nan": "checkpoint_minutes=nan is impossible",
    f"{TRAIN} --keep-checkpoints 0": "keep_checkpoints=0 is impossible",
    f"{TRAIN} --processes sometimes": "processes='sometimes' is impossible: it must be auto or always or never",
    f"{TRAIN} --observe 1": "give indices from 0 to 0",
    f"{TRAIN} --observe -1": "observe=(-1,) does not fit",
    f"{TRAIN} --observe velocities": "does not say which of its observations are velocities",
    f"{MLP} pendulum --observe 3": "give indices from 0 to 2",
    f"{MLP} pendulum --observe speed": "observe=speed cannot be understood",
    f"{MLP} pendulum --observe 0 velocities": "cannot be understood",
    f"{MLP} pendulum --constants mass": "--constants mass cannot be understood: write NAME=VALUE",
    f"{MLP} pendulum --constants =3": "--constants =3 cannot be understood",
    f"{MLP} pendulum --constants weight=3": "has no constant 'weight': it has gravity, mass",
    f"{MLP} gym:": "Gymnasium has no environment ''",
    f"{MLP} gym:Pendulm-v1": "Gymnasium has no environment 'Pendulm-v1'",
    f"{MLP} gym:Pendulum-v0": "Gymnasium has no environment 'Pendulum-v0'",
    f"{MLP} gym:no_such_module:Robot-v0": "no_such_module",
    f"{MLP} gym:CartPole-v1": "not discrete",
    f"{MLP} gym:MountainCar-v0": "not discrete",
    f"{MLP} gym:Pendulum-v1 --observe 3": "give indices from 0 to 2",
    f"{MLP} gym:Pendulum-v1 --observe first": "cannot be understood",
    f"{MLP} gym:Pendulum-v1 --constants max_episode_steps=0": "max_episode_steps=0 is impossible",
    f"{MLP} gym:Pendulum-v1 --constants max_episode_steps=long": "max_episode_steps=long is impossible",
    f"{MLP} gym:Pendulum-v1 --constants weight=3": "gym:Pendulum-v1 cannot be made: TypeError",
    f"{MLP} Pendulum-v1": "no task 'Pendulum-v1'",
    "train sac-mlp hoper": "did you mean hopper?",
    "resume": "RUN is missing",
    "resume missing": "no run folder missing",
    "resume there": "there is not a run",
    "resume broken": "broken/config.json cannot be read",
    "resume untrained": "untrained has no checkpoint to go on from",
    "resume untrained --steps many": "--steps cannot be 'many'",
    "resume untrained extra": "one argument too many, 'extra'",
    "resume halved": "halved has no checkpoint to go on from",
    "resume foreign": "no checkpoint to go on from",
    "show": "RUN is missing",
    "show missing": "no run folder missing",
    "show broken": "broken/config.json cannot be read",
    "show foreign": "no agent 'foreign'",
    "show scribbled": "Line 2 of scribbled/metrics/seed-0.jsonl is damaged",
    "show resultless": "resultless/results.json is damaged",
    "evaluate unknown": "unknown was trained on nowhere, which is not a task of this library",
    "evaluate overset": "has no hyperparameter 'colour'",
    "evaluate masked": "give indices from 0 to 0",
    "evaluate list": "list/config.json lacks",
    "evaluate binary": "binary/config.json cannot be read",
    "evaluate untrained --json extra": "one argument too many",
}


def prepare(folder):
    """Runs that have something wrong with them."""
    config = {
        "agent": "vrm",
        "hyperparameters": {"d_size": 4},
        **tasks.describe(tasks.make("pendulum-v")),
        "options": {"steps": 100, "seed": 0, "seeds": 1},
    }
    whole = json.dumps(config)
    contents = {
        "broken": whole[:50],
        "empty": "{}",
        "list": "[1, 2]",
        "binary": "\x00\x01\xff",
        "foreign": json.dumps(config | {"agent": "foreign"}),
        "unknown": json.dumps(config | {"task": "nowhere"}),
        "overset": json.dumps(config | {"hyperparameters": {"colour": 1}}),
        "masked": json.dumps(config | {"observe": [5]}),
    } | dict.fromkeys(("untrained", "damaged", "halved", "scribbled", "resultless"), whole)
    for name, content in contents.items():
        (folder / name / "metrics").mkdir(parents=True)
        (folder / name / "config.json").write_text(content)
    (folder / "damaged" / "agent.safetensors").write_bytes(b"nonsense")
    (folder / "halved" / "checkpoints" / ".000001-step-10.tmp").mkdir(parents=True)
    (folder / "scribbled" / "metrics" / "seed-0.jsonl").write_text('{"step": 1, "kind": "update"}\nhello\n')
    (folder / "resultless" / "results.json").write_text('{"step": 10')
    (folder / "there").mkdir()
    (folder / "there" / "file").write_text("keep me")
