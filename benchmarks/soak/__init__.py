"""A recorder that runs for long while everything around it fails at random: `make soak`.

`triaxcal record` runs as a process of its own, with simulated units in others: on CAN, on an RS-485 line and behind a
Modbus gateway. From a seed units lose their supply, buses fall silent, connections break, replies are lost, late,
foreign or garbled, foreign frames flood the bus, and the recorder is stopped or killed. In the end each sample that a
unit has sent is looked for in its recording. One that is not there has to be told of there: by a gap, by the unit's own
count, by requests that failed, or by the recorder's own absence. What nothing tells of is a silent loss.
"""
