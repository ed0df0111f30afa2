"""A training's log for TensorBoard: `pip install tensorboardX`, then `python tensorboard_log.py`.

`tensorboard --logdir runs` shows it. Any object with these three methods follows a training
(`learning.Tracker`), for Weights & Biases or MLflow say.
"""

from math import isfinite

from tensorboardX import SummaryWriter

from cosim import train


class TensorBoard:
    def __init__(self, folder):
        self.writer = SummaryWriter(folder)

    def start(self, run):
        settings = run.configuration.model_dump(mode="json")
        self.writer.add_text("run", f"{run.algorithm} on {run.scenario.name}: {settings}")

    def __call__(self, samples, row):
        for name, value in row.items():
            if isfinite(value):
                self.writer.add_scalar(name, value, samples)
        self.writer.flush()

    def end(self, training):
        self.writer.add_text("status", training.status)
        self.writer.close()


if __name__ == "__main__":
    print(train("q-learning", "fouled", 4000, start="backed-off", progress=TensorBoard("runs/q")))
