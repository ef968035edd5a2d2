"""Thirty-six requests to the humanoid: 28 name a pose, 24 a gait, 16 both (see docs/guides/coach_live.md).

Each with what it means: the pose, and the step length relative to 0.475 m ("shorter", "longer") or in metres; None
where the request leaves it alone.
"""

REQUESTS = [
    # both
    ("short steps with your arms up", "arms_up", "shorter"),
    ("take long strides and hold your arms out to the sides", "t_pose", "longer"),
    ("walk like a zombie, tiny steps", "arms_in_front", "shorter"),
    ("T-pose, 0.55 m steps", "t_pose", 0.55),
    ("put your hands in the air and take bigger steps", "arms_up", "longer"),
    ("arms forward, steps of forty centimetres", "arms_in_front", 0.40),
    ("hands above your head but keep the steps small", "arms_up", "shorter"),
    ("stretch both arms in front of you and stride out", "arms_in_front", "longer"),
    ("do a T pose, and shorten your stride a little", "t_pose", "shorter"),
    ("reach for the sky with giant steps", "arms_up", "longer"),
    ("longest steps you can, arms straight ahead", "arms_in_front", "longer"),
    ("like an aeroplane, with a 35 cm step length", "t_pose", 0.35),
    ("take baby steps, arms up", "arms_up", "shorter"),
    ("spread your arms wide and walk with long steps", "t_pose", "longer"),
    ("not so long steps, and hands up", "arms_up", "shorter"),
    ("sleepwalk with shuffling feet", "arms_in_front", "shorter"),
    # pose alone
    ("raise your arms", "arms_up", None),
    ("hold your arms in front of you", "arms_in_front", None),
    ("make a cross with your body", "t_pose", None),
    ("hands up!", "arms_up", None),
    ("lift both hands over your head", "arms_up", None),
    ("arms out sideways please", "t_pose", None),
    ("pretend to carry a tray before you", "arms_in_front", None),
    ("T-pose instead of arms up", "t_pose", None),
    ("point your arms at the ceiling", "arms_up", None),
    ("let me see a t-pose", "t_pose", None),
    ("extend your arms forwards", "arms_in_front", None),
    ("arms to the side like wings", "t_pose", None),
    # gait alone
    ("shorter steps", None, "shorter"),
    ("your steps are too short", None, "longer"),
    ("0.6 m", None, 0.60),
    ("make the stride a good deal longer", None, "longer"),
    ("mince along daintily", None, "shorter"),
    ("10 cm more per step", None, 0.575),
    ("lengthen your stride", None, "longer"),
    ("could you walk with smaller steps?", None, "shorter"),
]
