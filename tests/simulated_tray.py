"""Files of a station's units and of the simulated units in its slots, on Modbus."""

UNIT = """
[[units]]
name = "{slot}"
profile = "triax-ref-modbus"
bus = {{ host = "127.0.0.1", port = {port}, unit_id = 1 }}
"""
DEVICE = """\
format = "triaxcal.device/1"
profile = "triax-ref-modbus"
serial = {serial}
seed = {serial}
slot = "{slot}"
speed = {speed}
bus = {{ host = "127.0.0.1", port = {port}, unit_id = 1 }}
[sensor]
noise_g = {noise_g}
[fixture]
reaction_s = 0.5
move_s = 0.6
"""
