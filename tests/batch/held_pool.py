"""A pool of two workers that end what they were given when a test says so."""

from concurrent.futures import Executor, Future


class Held(Executor):
    """The first task is done at once, the others when `finish` is called; a task that was given never stops."""

    def __init__(self):
        self.given = []

    def submit(self, call, task):
        future = Future()
        future.set_running_or_notify_cancel()
        self.given.append((future, call, task))
        if len(self.given) == 1:
            self.finish(0)
        return future

    def finish(self, number):
        future, call, task = self.given[number]
        future.set_result(call(task))
