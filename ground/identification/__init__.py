"""Identification of the testbed's constants, and the description of a satellite that was learned in flight.

For the testbed, the control loop executes an excitation, `record` reads the flight log, `fit` estimates the
constants per inertia, and `scale` gives the absolute values of the configuration's section `plant`.

The motion under a known current determines only the ratios of the constants to the inertia. The module
`scale` adds prior values from the configuration and the magnetometer, and states the contribution of each
source.

The attitude filter of a satellite learns the description in flight. The module `orbit` compares the learned
description with the configuration.
"""
