"""Callbacks that stop a run, or call a function, at a step."""

from dvae.inference.training.fit import Callback


class At(Callback):
    """Calls a function after one step."""

    def __init__(self, step, action):
        self.step, self.action = step, action

    def on_step(self, state):
        if state.step == self.step:
            self.action(state)


def interrupt(state):
    raise KeyboardInterrupt
