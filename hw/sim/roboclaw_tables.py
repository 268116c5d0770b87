"""RoboClaw's commands, as Basicmicro's user manual numbers them: what each read answers, and what each write carries.

SPEEDS, DUTIES, WAYS and PLACES say where in the data of a write the values stand, and of which motors they are.
"""

from __future__ import annotations

import struct

from hw import roboclaw

FULL_TICKS_PER_S = 5000.0  # at full duty
MOTOR_1, MOTOR_2 = 0, 1
BOTH = (MOTOR_1, MOTOR_2)
FACTS = {  # what does not change while it is looked at
    15: b"\0",  # serial timeout
    roboclaw.READ_VERSION: b"USB Roboclaw 2x15a v4.1.34\n\0",
    roboclaw.READ_MAIN_BATTERY: struct.pack(">H", 124),  # tenths of a volt
    25: struct.pack(">H", 50),
    55: struct.pack(">4I", 0x10000, 0x8000, 0x4000, round(FULL_TICKS_PER_S)),
    56: struct.pack(">4I", 0x10000, 0x8000, 0x4000, round(FULL_TICKS_PER_S)),
    59: struct.pack(">2HB", 60, 340, 0),
    60: struct.pack(">2H", 55, 340),
    82: struct.pack(">H", 250),  # tenths of a degree
    83: struct.pack(">H", 250),
    100: struct.pack(">2H", 124, 50),
    101: struct.pack(">2H", 250, 250),
    135: struct.pack(">2I", 1500, 0),  # hundredths of an ampere
    136: struct.pack(">2I", 1500, 0),
}
ZEROS = {  # reads: bytes of zeros
    48: 4, 49: 4, 63: 28, 64: 28, 72: 4, 75: 5, 77: 24, 81: 16, 90: 4, 91: 2, 97: 37, 99: 2, 103: 2, 104: 10, 107: 8, 110: 4,
    111: 4, 113: 4, 114: 4, 116: 2, 130: 8, 131: 8, 138: 1, 140: 3, 142: 2, 144: 1, 146: 1, 147: 1, 149: 2, 151: 1, 161: 2,
}  # fmt: skip
WRITES = {  # bytes of data
    0: 1, 1: 1, 2: 1, 3: 1, 4: 1, 5: 1, 6: 1, 7: 1, 8: 1, 9: 1, 10: 1, 11: 1, 12: 1, 13: 1, 14: 1, 20: 0, 22: 4, 23: 4,
    28: 16, 29: 16, 32: 2, 33: 2, 34: 4, 35: 4, 36: 4, 37: 8, 38: 8, 39: 8, 40: 12, 41: 9, 42: 9, 43: 17, 44: 13, 45: 13,
    46: 21, 50: 16, 51: 25, 52: 6, 53: 6, 54: 12, 57: 5, 58: 4, 61: 28, 62: 28, 65: 17, 66: 17, 67: 33, 68: 8, 69: 8, 70: 2,
    71: 2, 74: 5, 76: 24, 80: 4, 92: 1, 93: 1, 94: 4, 95: 0, 96: 37, 98: 2, 102: 10, 105: 4, 106: 4, 109: 4, 112: 4, 115: 2,
    119: 5, 120: 5, 121: 9, 122: 9, 123: 9, 124: 17, 125: 3, 126: 3, 127: 5, 128: 8, 129: 8, 133: 8, 134: 8, 137: 2, 139: 3,
    141: 2, 143: 53, 145: 10, 148: 2, 150: 1, 160: 2, 200: 0, 248: 0, 249: 0,
}  # fmt: skip
SPEEDS = {
    35: (">i", (MOTOR_1,)),
    36: (">i", (MOTOR_2,)),
    37: (">ii", BOTH),
    38: (">4xi", (MOTOR_1,)),
    39: (">4xi", (MOTOR_2,)),
    40: (">4xii", BOTH),
    50: (">4xi4xi", BOTH),
}
DUTIES = {
    32: (">h", (MOTOR_1,)),
    33: (">h", (MOTOR_2,)),
    34: (">hh", BOTH),
    52: (">h4x", (MOTOR_1,)),
    53: (">h4x", (MOTOR_2,)),
    54: (">h4xh4x", BOTH),
}
WAYS = {  # a speed and ticks to go at it; the last byte of the data: 1 at once, 0 behind what is under way
    41: (">iIx", (MOTOR_1,)),
    42: (">iIx", (MOTOR_2,)),
    43: (">iIiIx", BOTH),
    44: (">4xiIx", (MOTOR_1,)),
    45: (">4xiIx", (MOTOR_2,)),
    46: (">4xiIiIx", BOTH),
    51: (">4xiI4xiIx", BOTH),
}
PLACES = {  # a speed and the counter to go to; the last byte as above
    65: (">4xI4xix", (MOTOR_1,)),
    66: (">4xI4xix", (MOTOR_2,)),
    67: (">4xI4xi4xI4xix", BOTH),
}
SIMPLE = {0: (MOTOR_1, 1), 1: (MOTOR_1, -1), 4: (MOTOR_2, 1), 5: (MOTOR_2, -1)}  # of 127: forward, backward
FORWARD, BACKWARD, RIGHT, LEFT, DRIVE, TURN = range(8, 14)  # both motors mixed: of 127, the last two about 64
