"""One axis of a force sensor as the loop reads it, sample by sample."""

import numpy as np

from closedloop.control.sensor import bias_at, pack_sensor, sense, sensor_rates, signal_of, start_sensor
from closedloop.jit.interpreted import interpreted


class OneAxis:
    """A sensor along the normal that is at rest in a force at the start."""

    def __init__(self, section, period, force):
        self.sensor, self.period, self.samples = pack_sensor(section, period), period, 0
        self.z, self.ring = np.zeros(self.sensor.states), np.zeros((3, self.sensor.ring))
        start_sensor(force, self.sensor, self.z, np.zeros(3), self.ring)

    def read(self, force, normal=0.0):
        """Return the reading after a sample of a force, which lasts until the next."""
        par = self.sensor.par
        signal = interpreted(signal_of)(force, par, self.z)
        bias = interpreted(bias_at)(self.samples * self.period, 0, par)
        reading = interpreted(sense)(signal, bias, self.samples, par, normal, self.ring[0])
        rate = np.zeros(self.sensor.states)
        interpreted(sensor_rates)(force, par, self.z, rate)
        self.z += self.period * rate
        self.samples += 1
        return reading
