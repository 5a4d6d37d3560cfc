"""The landmarks that mean a place on the skin, and their numbers in the face network's 468 (pipeline.faces).

Not among them: the iris, the outline of the cheeks and of the jaw behind the chin (they slide with the view), and what
lies between two places without features of its own.
"""

MIDDLE = {
    "forehead": 151, "glabella": 9, "nasion_upper": 8, "nasion": 168, "nose_bridge_upper": 6, "nose_bridge": 197,
    "nose_bridge_lower": 195, "nose_tip_upper": 5, "nose_tip": 4, "nose_tip_lower": 1, "nose_base": 2,
    "philtrum": 164, "lip_upper_outer": 0, "lip_upper_inner": 13, "lip_lower_inner": 14, "lip_lower_outer": 17,
    "chin_fold": 18, "chin_upper": 200, "chin": 199, "chin_lowest": 152,
}  # fmt: skip
PAIRS = {  # name: right, left
    "eye_outer": (33, 263), "eye_inner": (133, 362), "lid_upper": (159, 386), "lid_upper_inner": (157, 384),
    "lid_upper_outer": (161, 388), "lid_lower": (145, 374), "lid_lower_inner": (154, 381),
    "lid_lower_outer": (163, 390), "brow_inner_upper": (107, 336), "brow_inner_lower": (55, 285),
    "brow_upper": (105, 334), "brow_lower": (52, 282), "brow_outer": (70, 300), "brow_outer_lower": (46, 276),
    "nose_wing": (129, 358), "nose_wing_upper": (198, 420), "nose_wing_base": (98, 327), "nostril_inner": (97, 326),
    "nose_side": (174, 399), "lip_peak": (37, 267), "lip_upper_side": (40, 270), "mouth_corner": (61, 291),
    "mouth_corner_inner": (78, 308), "lip_upper_inner_side": (81, 311), "lip_lower_inner_side": (178, 402),
    "lip_lower_side": (91, 321), "lip_lower_near": (84, 314), "chin_side": (148, 377), "cheekbone": (117, 346),
    "cheek": (50, 280), "nasolabial": (205, 425), "jaw": (149, 378),
}  # fmt: skip
ABOVE = ("lid_upper", "lip_upper", "lip_peak")  # of those at an opening, the names of what lies above it
