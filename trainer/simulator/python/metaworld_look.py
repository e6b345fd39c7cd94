"""How the scene looks: disturbances by strength. Neither physics nor the robot's own look ever change."""

import numpy as np

# What the camera sees of the room, by texture: the table's planks, its rim, the floor.
TABLE, RIM, FLOOR = "T_table", "T_wallmetal", "T_floor"
# The colours of the paper's Fig. 8, 0 to 255: darker wood, navy, pale mint.
PAPER = {TABLE: (96, 62, 40), RIM: (30, 38, 86), FLOOR: (206, 240, 222)}
# The camera moves by up to so many metres and turns by up to so many radians.
CAMERA_SHIFT, CAMERA_TURN = 0.02, np.deg2rad(2)
LEVELS = ("none", "paper", "surfaces", "light", "camera", "textures", "noise", "varied")


class Look:
    """Draws how an episode looks, of one of `LEVELS`.

    `paper` is fixed; the others are drawn anew for each episode. `varied` is for learning: of `surfaces` or `textures`, `light`, `camera`
    and `noise` each episode has some.
    """

    def __init__(self, model, camera, level):
        self.model, self.camera, self.level = model, camera, level
        is_robot = camera.robot_bodies[model.geom_bodyid]
        of_robot = set(model.geom_matid[is_robot])
        self.materials = [i for i in range(model.nmat) if i not in of_robot]
        self.geoms = np.flatnonzero(~is_robot & (model.geom_matid < 0))
        drawn = camera.drawn
        self.textures = [i for i in range(drawn.ntex) if drawn.tex_nchannel[i] == 3]
        self.pixels = [self._pixels(texture).copy() for texture in range(drawn.ntex)]
        arrays = ("mat_rgba", "geom_rgba", "light_diffuse", "light_ambient", "light_dir", "cam_pos", "cam_quat")
        self.pristine = {name: getattr(model, name).copy() for name in arrays}
        headlight = model.vis.headlight
        self.headlight = {name: getattr(headlight, name).copy() for name in ("ambient", "diffuse")}
        self.changed = set()
        # Whether sky and floor of every picture are noise.
        self.noise = False

    def change(self, random):
        """Draws a new look; the same random stream gives the same look."""
        for name, values in self.pristine.items():
            getattr(self.model, name)[:] = values
        for name, values in self.headlight.items():
            getattr(self.model.vis.headlight, name)[:] = values
        for texture in self.changed:
            self._pixels(texture)[:] = self.pixels[texture]
        before, self.changed = self.changed, set()
        parts = self._drawn_parts(random) if self.level == "varied" else [self.level]
        self.noise = "noise" in parts
        for part in parts:
            if part not in ("none", "noise"):
                getattr(self, f"_{part}")(random)
        for texture in sorted(before | self.changed):
            self.camera.upload(texture)
        self.camera.place()

    @staticmethod
    def _drawn_parts(random):
        parts = [random.choice(["none", "surfaces", "textures"], p=[0.3, 0.4, 0.3])]
        return parts + [part for part, share in (("light", 0.5), ("camera", 0.5), ("noise", 0.2)) if random.random() < share]

    def _paper(self, _):
        for name, colour in PAPER.items():
            self._tint(self.model.texture(name).id, colour)

    def _surfaces(self, random):
        for name in (TABLE, RIM, FLOOR):
            texture = self.model.texture(name).id
            if random.random() < 0.5:
                self._tint(texture, random.integers(20, 256, 3))
            else:
                self._paint(texture, random)

    def _textures(self, random):
        self.model.mat_rgba[self.materials, :3] = random.uniform(0.1, 1, (len(self.materials), 3))
        self.model.geom_rgba[self.geoms, :3] = random.uniform(0.1, 1, (len(self.geoms), 3))
        for texture in self.textures:
            self._paint(texture, random)

    def _light(self, random):
        # The scene is lit so that a brighter light hardly shows: darker ones do.
        colour = random.uniform(0.3, 1.2) * random.uniform(0.7, 1.3, 3)
        for light in (self.model.light_diffuse, self.model.light_ambient):
            light *= colour
        for name in self.headlight:
            getattr(self.model.vis.headlight, name)[:] *= colour
        angle = random.uniform(-1, 1)  # about the vertical
        cosine, sine = np.cos(angle), np.sin(angle)
        self.model.light_dir[:, :2] = self.model.light_dir[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])

    def _camera(self, random):
        camera = self.camera.view.fixedcamid
        shift, axis = random.normal(size=(2, 3))
        self.model.cam_pos[camera] += shift / np.linalg.norm(shift) * random.uniform(0, CAMERA_SHIFT)
        half = random.uniform(0, CAMERA_TURN) / 2
        turn = np.array([np.cos(half), *(np.sin(half) * axis / np.linalg.norm(axis))])
        self.model.cam_quat[camera] = product(self.model.cam_quat[camera], turn)

    def _pixels(self, texture):
        """A view of a texture as it is drawn, [height, width, channels] u8."""
        drawn = self.camera.drawn
        shape = drawn.tex_height[texture], drawn.tex_width[texture], drawn.tex_nchannel[texture]
        start = drawn.tex_adr[texture]
        return drawn.tex_data[start : start + int(np.prod(shape))].reshape(shape)

    def _tint(self, texture, colour):
        """The texture's own light and dark in another colour."""
        light = self.pixels[texture].mean(2, keepdims=True)
        self._pixels(texture)[:] = np.clip(light / max(light.mean(), 1) * np.asarray(colour), 0, 255)
        self.changed.add(texture)

    def _paint(self, texture, random):
        pixels = self._pixels(texture)
        pixels[:] = random_pattern(random, *pixels.shape[:2])
        self.changed.add(texture)


def product(a, b):
    """Of two quaternions, w first: first `b`, then `a`."""
    (aw, *av), (bw, *bv) = a, b
    av, bv = np.array(av), np.array(bv)
    return np.array([aw * bw - av @ bv, *(aw * bv + bw * av + np.cross(av, bv))])


def random_pattern(random, height, width):
    """Two colours in blocks, stripes or blotches. [height, width, 3] u8."""
    columns_of_cells = int(random.integers(4, 17))
    row, column = np.arange(height) * columns_of_cells // width, np.arange(width) * columns_of_cells // width
    cells = np.indices((row[-1] + 1, columns_of_cells))
    kind = random.choice(["checks", "stripes", "blotches"])
    if kind == "checks":
        share = cells.sum(0) % 2
    elif kind == "stripes":
        share = cells[random.integers(2)] % 2
    else:
        share = random.random(cells.shape[1:])
    one, other = random.integers(0, 256, (2, 3))
    colours = (share[..., None] * one + (1 - share[..., None]) * other).astype(np.uint8)
    return colours[row[:, None], column]
