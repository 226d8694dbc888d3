"""Where the gap lies: frequency, regime, amplitude, sensor, subsystem."""
