"""Identification of the testbed's constants, and the description of a satellite that was learned in flight.

For the testbed, the control loop executes an excitation, `record` reads the flight log, and `fit` estimates
the constants divided by the inertia. From these constants, prior values in the configuration and the
magnetometer, `fit` computes the absolute values for the configuration's section `plant`, and states the
contribution of each source.

The attitude filter of a satellite estimates inertia, coils and sensors in flight (the learned description of
the satellite). The functions of the module `orbit` compare these estimates with the configuration.
"""
