"""Settings of the source's methods: what its Table 3 leaves open, and what replaces it where it fails on our tasks.

Table 3 does not say over how many steps sigma falls, nor what happens where the curvature is not positive: `steps` and
`modification` are ours (`CHOSEN`). `RETUNED` replaces Table 3 where it fails on our version of a task. Settings were
scored on runs from 1000 upward, which no table reports, by the commands given with them; `tune` is
`python -m experiments tune`. Without a command they are single trials (our_h and our_hvp on BRDF and NONPSD; our_hvp on
TEXTURE). That our_h and our_hvp needed another search on BOX2 was seen on the reported runs.

- QUAD: as in Table 3.
- BOX2, BOX10: a start sigma of 1.5 or 0.6 pixels on a plateau of 100 moves nothing; ours is the side / 5 and side / 6,
  as in the authors' logs. The learning rates of Table 3 arrive on BOX2 only after thousands of evaluations.
- BOX10: of 13 settings for each method (`tune box10 --method M --runs 2 --trials 12 --evaluations 30000`) one of
  our_hvpa arrives, from one of two starts. Descent on the smoothed loss moves all five squares onto the central place,
  a local minimum at 58 % of the first error, from a start sigma of 0.001 as from one of 0.17. Only noisy steps lead
  elsewhere.
- TEXTURE: with 4 pairs a gradient of 1024 elements is nearly all noise, and so is a curvature. Adam needs a smaller
  learning rate. The line search needs more pairs, the mean as baseline, and no conjugate directions.
- BRDF, NONPSD, MIRROR, CAUSTIC and MESHFIT are not in Table 3, nor are SUZANNE and BANANA.
"""

from typing import Any

from experiments.problems.catalogue import MESHES

Settings = dict[str, Any]

CHOSEN: dict[str, dict[str, Settings]] = {
    # tune quad --method our_hvp --evaluations 20000 --over modification=abs,radius steps=100,400
    "quad": {
        "fr22": {"steps": 3000},
        "our_g": {"steps": 3000},
        "our_h": {"steps": 100, "modification": "radius"},
        "our_hvp": {"steps": 100, "modification": "radius"},
        "our_hvpa": {"steps": 100, "modification": "radius"},
    },
}
"""What Table 3 leaves open."""

_BOX2 = (0.2, 2e-5)
_BOX10 = (1 / 6, 2e-4)
_MESH: Settings = {"samples": 8, "learning_rate": 0.002, "sigma": (0.01, 0.003), "steps": 200}

RETUNED: dict[str, dict[str, Settings]] = {
    # tune box2 --method our_h --runs 12 --evaluations 12000 --over trust_region=0.05,0.1,0.2 \
    #     "line_search=(3,2e-6),(10,2e-6)" steps=160,320
    # tune box2 --method our_hvp --runs 20 --evaluations 6000 --over trust_region=0.2,0.5,2 modification=abs,radius \
    #     steps=40,80
    # tune box2 --method our_hvpa --runs 20 --evaluations 6000 --over trust_region=0.2,0.5,1 modification=abs,radius \
    #     steps=40,80
    # tune box2 --method our_g --runs 4 --trials 12 --evaluations 6000 --over learning_rate=0.01,0.02,0.05,0.1 \
    #     steps=30,100,300; the same for fr22
    "box2": {
        "fr22": {"learning_rate": 0.05, "sigma": _BOX2, "steps": 30},
        "our_g": {"learning_rate": 0.02, "sigma": _BOX2, "steps": 30},
        "our_h": {"sigma": _BOX2, "trust_region": 0.2, "line_search": (3, 2e-6), "steps": 160},
        "our_hvp": {"sigma": _BOX2, "trust_region": 0.5, "modification": "radius", "steps": 80},
        "our_hvpa": {"sigma": _BOX2, "trust_region": 0.2, "steps": 80},
    },
    "box10": {
        "fr22": {"sigma": _BOX10, "steps": 10_000},
        "our_g": {"sigma": _BOX10, "steps": 10_000},
        "our_h": {"sigma": _BOX10, "trust_region": 0.1, "steps": 60},
        "our_hvp": {"sigma": _BOX10, "trust_region": 0.5, "samples": 2, "recompute": 1, "steps": 1100},
        "our_hvpa": {
            "samples": 4,
            "sigma": (1 / 6, 1 / 600),
            "trust_region": 1.0,
            "line_search": (1, 0.0),
            "recompute": 1,
            "baseline": "mean",
            "steps": 160,
        },
    },
    # tune texture --method our_g --runs 2 --evaluations 40000 --over samples=4,8 learning_rate=0.005,0.01,0.02
    # tune texture --method our_hvpa --runs 2 --evaluations 60000 --over samples=64,128,256,512 recompute=1,30
    "texture": {
        "fr22": {"learning_rate": 0.01, "sigma": (0.1, 0.1)},
        "our_g": {"learning_rate": 0.01, "sigma": (0.1, 0.1)},
        "our_hvp": {"samples": 512, "sigma": (0.3, 0.1), "line_search": (1, 0.0), "recompute": 1, "steps": 30},
        "our_hvpa": {
            "samples": 256,
            "sigma": (0.3, 0.1),
            "line_search": (1, 0.0),
            "recompute": 1,
            "baseline": "mean",
            "steps": 50,
        },
    },
    # By hand on runs 100 to 102 with 1 000 simulations: eight combinations of lr and batch of our_g, whose best one
    # fr22 has too; six ranges of the radius of our_hvpa.
    "cnn_throw": {
        "fr22": {"lr": (2e-3, 2e-4)},
        "our_g": {"lr": (2e-3, 2e-4)},
        "our_hvpa": {"radius": (0.3, 0.01)},
    },
    # The rendered tasks: eight to twenty-four settings of each method on three starts. Table 3 gives up the plateau of
    # SHAD and spends most of its steps on the way elsewhere; it does not have MIRROR. What no setting brings to the
    # solution (our_hvp on MIRROR) keeps its own.
    # tune mug --method our_g --runs 3 --trials 8 --over learning_rate=0.2,0.3,0.6,1.0 samples=1,2 steps=50,100,150 \
    #     "sigma=(3.0,0.01),(3.0,0.3)"; the same for fr22
    # tune mug --method our_h --runs 3 --trials 8 --over trust_region=1.0,3.0,6.0 samples=1,2 \
    #     "line_search=(1,0.0),(3,0.0)" steps=10,20,40 "sigma=(3.0,0.01),(3.0,0.3)"; our_hvp with 0.5,1.0,2.0,4.0
    # tune mug --method our_hvpa --runs 3 --trials 12 --over trust_region=1.0,2.0,4.0 samples=1,2 recompute=1,5 \
    #     "line_search=(1,0.0),(2,0.0)" steps=20,40 "sigma=(3.0,0.01),(3.0,0.3)"
    "mug": {
        "fr22": {"learning_rate": 0.6, "sigma": (3.0, 0.3), "steps": 50},
        "our_g": {"learning_rate": 0.6, "steps": 50},
        "our_h": {"trust_region": 6.0, "sigma": (3.0, 0.3), "line_search": (1, 0.0), "steps": 10},
        "our_hvp": {"trust_region": 1.0, "sigma": (3.0, 0.3), "line_search": (1, 0.0), "steps": 20},
        "our_hvpa": {
            "trust_region": 2.0,
            "sigma": (3.0, 0.3),
            "line_search": (1, 0.0),
            "recompute": 1,
            "steps": 20,
        },
    },
    # tune shad --method fr22 --runs 3 --trials 10 --over learning_rate=0.05,0.1,0.2 samples=1,2,4 steps=50,100 \
    #     "sigma=(1.0,0.01),(1.5,0.01),(0.5,0.01)"; the same for our_g
    # tune shad --method our_hvpa --runs 3 --trials 14 --seed 1 --over samples=1,2,4 trust_region=0.3,0.5,1.0 \
    #     "sigma=(1.0,0.1),(0.7,0.05),(1.0,0.01),(0.5,0.01)" recompute=1,5 modification=abs,radius \
    #     baseline=mean,center "line_search=(1,0.0)" steps=20,40,60
    # tune shad --method our_hvp --runs 3 --trials 10 --seed 1 --over samples=1,2 trust_region=0.2,0.4,0.7 \
    #     "sigma=(1.0,0.1),(0.7,0.05),(0.5,0.01)" recompute=1,5 modification=abs,radius "line_search=(1,0.0)" \
    #     steps=20,40
    # tune shad --method our_h --runs 3 --trials 8 --seed 1 --over samples=1,2 trust_region=0.1,0.2,0.4 recompute=1,5 \
    #     "sigma=(1.0,0.1),(0.7,0.05),(0.5,0.01)" modification=abs,radius "line_search=(1,0.0)" steps=20,30
    "shad": {
        "fr22": {"samples": 2, "learning_rate": 0.05, "steps": 100},
        "our_g": {"learning_rate": 0.05, "sigma": (1.0, 0.01), "steps": 150},
        "our_h": {"trust_region": 0.4, "line_search": (1, 0.0), "recompute": 1, "modification": "abs", "steps": 20},
        "our_hvp": {
            "samples": 2,
            "trust_region": 0.7,
            "sigma": (0.7, 0.05),
            "line_search": (1, 0.0),
            "modification": "radius",
            "steps": 20,
        },
        "our_hvpa": {
            "samples": 4,
            "trust_region": 0.3,
            "line_search": (1, 0.0),
            "recompute": 1,
            "modification": "radius",
            "steps": 60,
        },
    },
    # tune bunny --method our_g --runs 3 --trials 8 --over learning_rate=0.02,0.04,0.08 samples=1,2,4 steps=25,50,100 \
    #     "sigma=(0.25,0.0025),(0.1,0.0025)"; the same for fr22
    # tune bunny --method our_hvpa --runs 3 --trials 10 --over trust_region=0.5,1.0,2.0 samples=1,2,4 recompute=1,5 \
    #     "line_search=(1,0.0),(3,0.0)" steps=20,40 "sigma=(0.25,0.0025),(0.1,0.0025)"
    # tune bunny --method our_h --runs 1 --trials 2 --seed 1 --over trust_region=0.1,0.2 samples=1 \
    #     "line_search=(1,0.0)" recompute=5 steps=16 "sigma=(0.25,0.0025)"
    "bunny": {
        "fr22": {"learning_rate": 0.02, "sigma": (0.25, 0.0025), "steps": 50},
        "our_g": {"learning_rate": 0.02, "sigma": (0.25, 0.0025), "steps": 50},
        "our_h": {
            "samples": 1,
            "trust_region": 0.1,
            "sigma": (0.25, 0.0025),
            "line_search": (1, 0.0),
            "steps": 16,
        },
        "our_hvp": {"trust_region": 2.0, "sigma": (0.1, 0.0025), "line_search": (1, 0.0), "steps": 40},
        "our_hvpa": {
            "trust_region": 1.0,
            "sigma": (0.1, 0.0025),
            "line_search": (1, 0.0),
            "recompute": 5,
            "steps": 40,
        },
    },
    # tune mirror --method our_g --runs 3 --trials 10 --over learning_rate=0.01,0.02,0.04,0.08 samples=1,2,4 \
    #     steps=25,50,100 "sigma=(0.25,0.0025),(0.1,0.0025),(0.4,0.0025)"; the same for fr22
    # tune mirror --method our_hvpa --runs 3 --trials 12 --over trust_region=0.5,1.0,2.0 samples=1,2,4 recompute=1,5 \
    #     "line_search=(1,0.0),(3,0.0)" steps=20,40 "sigma=(0.25,0.0025),(0.1,0.0025),(0.4,0.0025)"
    "mirror": {
        "fr22": {"samples": 2, "learning_rate": 0.02, "sigma": (0.1, 0.0025), "steps": 100},
        "our_g": {"samples": 1, "learning_rate": 0.02, "sigma": (0.1, 0.0025), "steps": 50},
        "our_hvpa": {
            "samples": 2,
            "trust_region": 2.0,
            "sigma": (0.4, 0.0025),
            "line_search": (1, 0.0),
            "recompute": 1,
            "steps": 20,
        },
    },
    # tune brdf --method our_hvpa --evaluations 12000 --over trust_region=0.5,1 modification=abs,radius
    "brdf": {
        "fr22": {"learning_rate": 0.01, "sigma": (0.2, 0.01), "steps": 600},
        "our_g": {"learning_rate": 0.01, "sigma": (0.2, 0.01), "steps": 600},
        "our_h": {"trust_region": 0.1, "sigma": (0.2, 0.01), "line_search": (3, 0.0), "recompute": 7, "steps": 100},
        "our_hvp": {"trust_region": 0.5, "sigma": (0.2, 0.01), "line_search": (3, 0.0), "recompute": 7, "steps": 100},
        "our_hvpa": {"trust_region": 0.5, "sigma": (0.2, 0.01), "line_search": (3, 0.0), "recompute": 7, "steps": 100},
    },
    # tune nonpsd --method our_hvpa --evaluations 10000 --over trust_region=0.5,1 modification=abs,radius
    "nonpsd": {
        "fr22": {"learning_rate": 0.05, "sigma": (1.0, 0.01), "steps": 300},
        "our_g": {"learning_rate": 0.05, "sigma": (1.0, 0.01), "steps": 300},
        "our_h": {"trust_region": 0.5, "sigma": (1.0, 0.01), "line_search": (3, 0.0), "recompute": 5, "steps": 50},
        "our_hvp": {"trust_region": 0.5, "sigma": (1.0, 0.01), "line_search": (3, 0.0), "recompute": 5, "steps": 50},
        "our_hvpa": {"trust_region": 0.5, "sigma": (1.0, 0.01), "line_search": (3, 0.0), "recompute": 5, "steps": 50},
    },
    # Single trials on run 1000, twelve of our_g: learning rates 0.03 to 0.2, start sigma 0.2 to 1.5, 4 and 16 pairs.
    # This one is the best at 50 000 evaluations; a rate of 0.1 is ahead until 10 000 and gets no further than 0.118.
    "caustic": {
        "fr22": {"learning_rate": 0.03, "sigma": (1.0, 0.3), "steps": 6000},
        "our_g": {"learning_rate": 0.03, "sigma": (1.0, 0.3), "steps": 6000},
        "our_hvpa": {
            "samples": 256,
            "sigma": (1.0, 0.3),
            "line_search": (1, 0.0),
            "recompute": 1,
            "baseline": "mean",
            "steps": 60,
        },
    },
    # tune texture100 --method our_g --runs 1 --evaluations 2000 --level 0.08
    #   --over learning_rate=0.005,0.01,0.02 samples=4,8,16 sigma=(0.1,0.1)
    "texture100": {"our_g": {"learning_rate": 0.01, "sigma": (0.1, 0.1), "samples": 8}},
    # tune caustic64 --method our_g --runs 1 --evaluations 2000 --level 0.5
    #   --over learning_rate=0.1,0.3,1.0 samples=1,2,4 sigma=(1.0,0.3),(1.0,0.1),(0.3,0.1)
    "caustic64": {"our_g": {"learning_rate": 0.3, "sigma": (1.0, 0.1), "samples": 2}},
    # Single trials; the methods for meshes (`experiments.methods.mesh_handles`) have their defaults.
    **{name: dict.fromkeys(("fr22", "our_g"), _MESH) for name in MESHES},
}
"""What replaces Table 3, or stands for it; `tune` is `python -m experiments tune`."""
