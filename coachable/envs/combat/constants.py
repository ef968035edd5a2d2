"""Constants of the game that are in no table, with their units. "(paper)" marks the paper's; the others are ours."""

import math

# -- time ----------------------------------------------------------------------------------------------------------
FPS = 30  # frames per second (paper: about 30)
DT = 1.0 / FPS  # [s]
FRAMES_PER_STEP = 6  # a pad state is held this long, so that the agent acts at 5 Hz (paper)
CONTROL_STEP = FRAMES_PER_STEP * DT  # [s]
EPISODE_STEPS = 4500  # (paper)

# -- arena ---------------------------------------------------------------------------------------------------------
SPAWN_RADIUS = 25.0  # [m] around the site's centre (paper)
SPAWN_GAP = 8.0  # [m] between any two at the start
BOUND_RADIUS = 30.0  # [m] of the Dynamic Anchor Bound
PILLARS = ((12.0, 12.0), (12.0, -12.0), (-12.0, 12.0), (-12.0, -12.0))  # [m]
PILLAR_RADIUS = 1.5  # [m]

# -- player --------------------------------------------------------------------------------------------------------
PLAYER_HP = 700.0  # (paper)
BERRIES, BERRY_HP, BERRY_COOLDOWN = 14, 105.0, 0.8  # (paper), (paper) [HP], [s]
STAMINA, STAMINA_GAIN, SPRINT_COST, DODGE_COST = 100.0, 14.0, 6.0, 20.0  # [1], [1/s], [1/s], [1]
WEAPON_STAMINA, WEAPON_STAMINA_GAIN, TECHNIQUE_COST, TECHNIQUE_FACTOR = 100.0, 4.0, 50.0, 2.0  # [1], [1/s], [1], [1]
RUN, SPRINT, AIM_WALK, SWING_FACTOR = 6.0, 8.0, 2.8, 0.4  # [m/s] x 3, factor while swinging the spear
DODGE_SPEED, DODGE_TIME, DODGE_SAFE = 10.0, 0.45, 0.33  # [m/s], [s], [s] invulnerable
SLIDE_SPEED, SLIDE_TIME = 7.0, 0.5  # [m/s], [s]
JUMP_TIME = 0.6  # [s]
STICK_REST = 0.1  # a stick pushed less gives no direction
SWAP_TIME = 0.35  # [s]
WHEEL_REACH = 0.5  # of the right stick, from which it points at the wheel
BODY_RADIUS = 0.5  # [m]
EYE_HEIGHT = 1.5  # [m]
TURN_RATE, AIM_TURN_RATE, PITCH_FACTOR, STICK_EXPONENT = 3.8, 2.0, 0.6, 1.7  # [rad/s] x 2, [1], [1]
PITCH_MAX = 0.9  # [rad]
ASSIST = {"full": (0.26, 0.12), "small": (0.5, 0.3), "off": (0.0, 0.0)}  # cone [rad], share per frame

# -- spear ---------------------------------------------------------------------------------------------------------
LIGHT_DAMAGE, LIGHT_TIME, HEAVY_DAMAGE, HEAVY_TIME = 12.0, 0.42, 30.0, 0.95  # [HP], [s]
MELEE_CONE, MELEE_REACH = 0.9, 3.0  # [rad] either side, [m] beyond the body's radius
LUNGE, LUNGE_GAP = 1.6, 5.5  # [m] forward at most, [m] to the body within which it lunges

# -- being hit -----------------------------------------------------------------------------------------------------
HEAVY_HIT = 60.0  # [HP], a harder hit staggers
STAGGER_TIME, CHARGE_STAGGER_TIME, HEAVY_SAFE, LIGHT_SAFE = 0.45, 0.9, 0.7, 0.25  # [s]

# -- traps and hazards ---------------------------------------------------------------------------------------------
TRAP_SLOTS, TRAP_AHEAD, TRAP_ROOT, TRAP_ARM = 4, 1.2, 2.0, 1.0  # [1], [m], [s], [s]
TRAP_TRIGGER, TRAP_BLAST, TRAP_SELF_DAMAGE = 1.6, 2.5, 60.0  # [m] beyond the body, [m], [HP] to the player
CLOSENESS_SCALE = 8.0  # [m]
HAZARD_SLOTS, HAZARD_RADIUS, HAZARD_TIME, HAZARD_DPS = 2, 3.0, 4.0, 10.0  # [1], [m], [s], [HP/s]
REACHABLE_HEIGHT = 2.0  # [m], spear and traps reach a machine below it

# -- shots at the machine ------------------------------------------------------------------------------------------
BODY_SPHERE = 0.9  # of the machine's radius
PART_DISTANCE = 1.08  # of the radius, from the body's centre
PART_SPHERE, PART_SPHERE_EXTRA = 0.22, 0.12  # of the radius, [m]
SHIELD_FACTOR, CANISTER_FACTOR, TEAR_FACTOR = 0.4, 1.25, 1.5
UNIT_HP = {"shield": 0.06, "weapon": 0.10, "canister": 0.05}  # of 1.6 HP^0.85
BURST_DAMAGE, BURST_SHARE = 12.0, 0.02  # [HP], of the machine's health

# -- elements ------------------------------------------------------------------------------------------------------
THRESHOLD, THRESHOLD_SCALE = 45.0, 1.6  # build-up for a state: 45 + 1.6 sqrt(HP)
GAUGE_DECAY = 0.02  # of the threshold per second
DRENCHED_DAMAGE, DRENCHED_BUILDUP = 0.5, 1.5  # purgewater: its ranged and area damage, other elements' build-up
SHOCK_GROWTH = 1.6  # of shock's threshold, each time
PLASMA_SHARE = 0.35  # of the damage meanwhile, released at the end
GLUED_SPEED, GLUED_TELEGRAPH = 0.45, 1.4  # adhesive

# -- machine -------------------------------------------------------------------------------------------------------
APPROACH = {"small": 4.0, "charger": 9.0, "brute": 5.0, "titan": 5.0, "stalker": 5.0}  # [m]
STRAFE_FACTOR, STRAFE_FLIP, CHARGE_FACTOR = 0.45, 0.008, 2.1  # of its speed, per frame, of its speed
MACHINE_LAG, MACHINE_TURN = 0.3, 3.5  # per frame, [rad/s]
PAUSE_LOW, PAUSE_HIGH, PAUSE_RAGE = 0.6, 1.8, 0.35  # [s], [s], share less near death
STAGGER_SHARE, STAGGER_BASE, MACHINE_STAGGER = 0.22, 60.0, 1.6  # of HP, [HP], [s]
CONE_MARGIN, CHARGE_GAP, AREA_MARGIN = 0.5, 0.6, -0.5  # [m]
CONE_COSINE = 0.5  # 60 degrees either side
SHOT_SPEED, SHOT_LEAD, SHOT_NOISE, SHOT_RADIUS, SHOT_SLOTS = 28.0, 0.8, 0.5, 1.5, 4  # [m/s], [1], [m], [m], [1]
DAMAGE_LOW, DAMAGE_HIGH = 0.85, 1.15  # factor of each hit, uniform
RANGED_REST = 0.5  # ranged damage x (0.5 + 0.5 share of weapon parts left)

# -- rewards -------------------------------------------------------------------------------------------------------
SCREEN_COSINE = math.cos(math.radians(30.0))  # half of the 60 degrees that count as on screen
BUILDUP_LOW, BUILDUP_HIGH = -0.1, 1.0  # (paper)
