"""Steps of a stage that is run without a runner."""

from contextlib import contextmanager


class Silent:
    """Steps of which only the facts are kept."""

    def __init__(self):
        self.facts, self.kept, self.done = {}, {}, 0

    @contextmanager
    def task(self, name="", total=None):
        yield lambda: None

    def fact(self, name, value):
        self.facts[name] = value

    def run(self, work, count, *_, stalled=lambda done: False, **__):
        for iteration in range(count):
            if stalled(iteration):
                return
            work.step(iteration)

    def repeat(self, work, count, first):
        self.run(work, count)
