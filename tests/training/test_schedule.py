"""The order of the phases, as their events show it: first networks, notes after the pre-training, evaluations."""

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl import tasks
from beliefrl.runs.options import Options
from beliefrl.training import keys
from beliefrl.training.schedule import stages
from worlds import Alternating, Counting, CountingAgent


def events(agent, task, steps=7, seed=0, seeds=1):
    """The events of a short training."""
    return stages(agent, task, Options(steps=steps, seed=seed, seeds=seeds, eval_every=7, eval_episodes=1))


class Drawn(CountingAgent):
    """Begins with a random offset."""

    def init(self, key, spec):
        return super().init(key, spec)._replace(offset=jax.random.normal(key))


def test_no_two_purposes_and_no_two_steps_have_one_key():
    purposes = keys.ACT, keys.UPDATE, keys.SAMPLE, keys.CYCLE, keys.PRETRAIN, keys.REFRESH, keys.EVALUATE, keys.REVIVE
    made = [keys.step_key(jax.random.key(3), jnp.array(step), each) for each in purposes for step in (0, 1, 7)]
    assert len({tuple(jax.random.key_data(key).tolist()) for key in made}) == 3 * len(purposes)


def test_every_evaluation_plays_episodes_of_its_own():
    """The agent does not change, and the task begins at random."""
    task = tasks.make("pendulum", max_steps=7)
    found = [event.evaluation for event in events(CountingAgent(), task, steps=14) if event.evaluation is not None]
    returns = [float(total) for evaluation in found for total in evaluation.episode_return.ravel()]
    assert len(set(returns)) == len(returns) == 4


def test_seeds_begin_with_networks_of_their_numbers():
    (zero, one), (alone,) = (
        next(event.states.offset.tolist() for event in events(Drawn(), Counting(), **options) if event.states)
        for options in ({"seeds": 2}, {"seed": 1})
    )
    assert zero != one
    assert alone == one


class Noting(CountingAgent):
    """Notes how many updates it has had."""

    def act(self, state, memory, step, key, explore):
        return super().act(state, memory, step, key, explore)[0], state.offset

    def note(self, memory):
        return (memory,)


def test_after_the_pretraining_the_replay_has_new_notes():
    noted = {}
    for event in events(Noting(), Counting(), steps=14):
        if event.snapshot is not None:
            replay = event.snapshot.seeds.replay
            (notes,) = replay.timesteps.note
            noted.setdefault(event.snapshot.progress[1:3], np.unique(notes[0, : int(replay.added[0])]).tolist())
        if len(noted) == 3:
            break
    assert noted == {(0, False): [0.0], (3, False): [0.0], (3, True): [3.0]}


class Averaging(CountingAgent):
    """Its action is its offset, which is half more in what is evaluated."""

    def networks(self, state):
        return state._replace(offset=state.offset + 0.5)

    def act(self, state, memory, step, key, explore):
        return state.offset[None], memory + 1


def test_what_is_evaluated_are_the_networks_of_the_agent():
    """The return of seven alternating rewards is minus the action."""
    found = [event.evaluation for event in events(Averaging(), Alternating()) if event.evaluation is not None]
    np.testing.assert_array_equal(found[0].episode_return, np.full((1, 2, 1), -0.5))
