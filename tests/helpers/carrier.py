"""A stand-in for a controller of which only θ matters."""


class Carrier:
    """Carries θ and nothing else."""

    def __init__(self, parameters):
        self.parameters = parameters

    @property
    def theta(self):
        return self.parameters.theta

    @theta.setter
    def theta(self, theta):
        self.parameters = self.parameters.with_theta(theta)
