"""Split of the image of ``path`` into a part that virtual lights carry and one that is traced: plugin ``manylights``.

What a first surface receives by way of a second one, and where there are many emitters straight from these, is split
so that nothing is left out or clamped (``floors``)::

    pilot -> balance (decision) -> surface_lights (cells) -> light tree
    camera rays -> remainder (next_event, numbers) -> gather vertices -> pixel_clusters -> radiance

In the order to read in:

- ``facing``: which of six ways a surface faces
- ``floors``: the split: floors of BSDFs, and the share w of virtual lights
- ``sites``: cubes of space, each for six ways to face, for which something is learned
- ``worth``: what it is worth to follow a path
- ``paths``: where paths begin, what they carry along, what they find
- ``remainder``: paths as ``path`` follows them, less what virtual lights carry; ``follow``
- ``next_event``: next-event estimation: how emitters are chosen
- ``irradiance``: of surfaces, straight from emitters
- ``site_choice``: a choice among sources of light by what vertices of a pilot see, site by site
- ``learned_emitters``: emitters, and regions of the environment, chosen so
- ``tree_emitters``: many emitters, chosen so by clusters
- ``emitter_samples``: what these choices return: directions to emitters, and emitters that were met
- ``emitter_tree``: a tree over emitters with a place, by which one is drawn for a vertex
- ``numbers``: random numbers that are spread well over the samples of a pixel
- ``view_lights``: the lights of a view
- ``view``: camera rays, and paths that begin with them
- ``gather_vertices``: vertices where virtual lights are gathered, and which of the later ones are
- ``balance``: whether lights pay, how many, how finely they are clustered
- ``pixel_means``: how bright the image is around its pixels, from values at some of them
- ``pilot``: a few paths that tell where light is wanted
- ``decision``: what a view is followed with: pilots, the balance that they lead to, what paths are worth
- ``emitter_lights``: many emitters as virtual lights, which cuts stand for instead of a sample of one
- ``cells``: boxes where camera paths arrive, and random lines that meet surfaces in them with a known density
- ``surface_lights``: a virtual light wherever such a line meets a surface
- ``kept_lights``: these, for other cameras in the same scene
- ``pixel_clusters``: one light cut for those gather vertices of a pixel that face the same way
"""
