"""Which tests `make test-fast` and `make test` leave out. `make test-full` runs all, with many samples.

A test is slow if it takes seconds, and if what it would notice is noticed by others as well, or is of interest to
releases only. No deliberate fault of `mutants.py` is noticed by slow tests alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

#: What `make test-fast` runs: tests of one part each, and derivatives of one case of each kind.
FAST_MODULES = (
    "agreement batch constants edge_tree edges emitter_boxes exr finite options projection scenes what_hides zscores"
)
FAST_CASES = (
    "two_triangles_green cube_depth cube_welded coloured_cube_camera textured_cube_side orthographic_camera "
    "thin_lens_camera fisheye_camera gaussian_filter near_plane_cut smooth_torus room_cube shadow_blocker "
    "shadow_camera shadow_light glossy_receiver open_air spot_light sun_cube led_cube distant_lights sphere_soft "
    "cylinder_soft sky_blocker surroundings_turn glowing_torus coarse_lamp_cube reflecting_cube"
)

#: Cases that `make test` has besides: those that notice a fault, and one of each kind that takes longer.
MORE_CASES = (
    "batch_camera leaving_the_frame near_light spot_cube spot_light_turn spot_camera sun_turns lit_room_light "
    "led_moves distant_cube discs_lights discs_radius smooth_torus_sun sphere_sun sphere_light surroundings "
    "reflecting_ball light_out_of_frame sunk_cube_slides knot mirrored_sphere mirror_camera glass_tetrahedron "
    "checkerboard_close aligned_ball mirrored_lamp beam_turns picture_turns cornell_box hidden_shadow "
    "hidden_picture box_behind_glass spike patchwork_camera stretched_ball lampshade_wall sunk_sphere_slides "
    "pillar_turns strip_wall cut_bulb polished_camera polished_floor polished_rises cup_in_metal fine_camera "
    "fine_look fine_wall rippled_mirror checkers_throw checkers_beside lamp_slides coarse_normals coarse_slides "
    "coarse_hill wall_in_water window_in_floor glass_in_floor coarse_veil coarse_behind_pane checkered_facets "
    "pictured_globe shiny_leaf box_on_lines dome cup stair shelf can_on_box carpet box_in_lines box_on_corners "
    "steps books front_view plan glass_plan inside_out mirror_throws mirror_throws_camera lamp_in_bulb"
)

#: Slow tests, by how their names begin.
SLOW = """
test_adversarial.py::test_scores_survive_a_checkpoint
test_adversarial.py::test_the_sign_is_seen_and_moves
test_aov_edge.py::test_backward_is_the_transpose_of_forward[camera-box-None]
test_aov_edge.py::test_backward_is_the_transpose_of_forward[shape-gaussian
test_aov_edge.py::test_frozen_is_unfrozen[lit-sensor.to_world]
test_aov_edge.py::test_other_variants[llvm_ad_mono]
test_batch.py::test_forward_and_backward_agree[direct_edge-cube
test_batch.py::test_forward_and_backward_agree[prb_edge
test_bdpt.py::test_advice[door_ajar
test_bdpt.py::test_advice[lit_room
test_bdpt.py::test_caustics_of_lights_without_size[led
test_bdpt.py::test_caustics_of_lights_without_size[point
test_bdpt.py::test_caustics_of_lights_without_size[spot
test_bdpt.py::test_filters[False-lanczos
test_bdpt.py::test_filters[False-mitchell
test_bdpt.py::test_filters[False-tent
test_bdpt.py::test_filters[True-lanczos
test_bdpt.py::test_filters[True-mitchell
test_bdpt.py::test_filters[True-tent
test_bdpt.py::test_interpolated_normals
test_bdpt.py::test_lights[constant
test_bdpt.py::test_lights[cylinder
test_bdpt.py::test_lights[disk
test_bdpt.py::test_lights[led
test_bdpt.py::test_lights[projector
test_bdpt.py::test_lights[sphere
test_bdpt.py::test_lights[spot
test_bdpt.py::test_lights[sunsky
test_bdpt.py::test_lights[texture
test_bdpt.py::test_monochrome
test_bdpt.py::test_normal_maps[metal
test_bdpt.py::test_options[max_depth 0
test_bdpt.py::test_options[max_depth 2
test_bdpt.py::test_options[max_depth 3
test_bdpt.py::test_options[max_depth 4 light_paths
test_bdpt.py::test_scenes_of_derivatives
test_bdpt.py::test_sensors[clipping
test_bdpt.py::test_sensors[principal
test_bdpt.py::test_shipped_scenes
test_bdpt.py::test_surfaces[blend
test_bdpt.py::test_surfaces[blinn_phong
test_bdpt.py::test_surfaces[metal
test_bdpt.py::test_surfaces[mirror
test_bdpt.py::test_surfaces[plastic
test_bdpt.py::test_surfaces[principled
test_bdpt.py::test_surfaces[rough plastic
test_bdpt.py::test_surfaces[thin glass
test_bdpt_edge.py::test_any_number_of_light_paths[0.1
test_bdpt_edge.py::test_any_number_of_light_paths[2.0
test_bdpt_edge.py::test_both_modes[caustic_lamp
test_bdpt_edge.py::test_both_modes[cornell_box_camera
test_bdpt_edge.py::test_both_modes[door
test_bdpt_edge.py::test_both_modes[veil_and_mirror
test_bdpt_edge.py::test_frozen[<lambda>
test_bdpt_edge.py::test_interior_is_that_of_path_replay[ball_on_floor
test_bdpt_edge.py::test_interior_is_that_of_path_replay[mirrored_sphere
test_bdpt_edge.py::test_interior_is_that_of_path_replay[rough_panes
test_bdpt_edge.py::test_interior_is_that_of_path_replay[spot_behind_screen
test_bdpt_edge.py::test_shadows_continued_from_the_light
test_bdpt_edge.py::test_shadows_in_light_from_surfaces
test_blinn_phong.py::test_shadows_and_reflections_move
test_blinn_phong.py::test_textures_in_a_render[diffuse_reflectance-direct_edge]
test_blinn_phong.py::test_textures_in_a_render[roughness-prb_edge]
test_blinn_phong.py::test_textures_in_a_render[specular_reflectance-direct_edge]
test_blinn_phong.py::test_textures_in_a_render[specular_reflectance-prb_edge]
test_chains.py::test_a_ball_on_a_floor
test_chains.py::test_forward_equals_backward
test_coarse_meshes.py::test_agrees_with_finite_differences[camera]
test_coarse_meshes.py::test_agrees_with_finite_differences[indirect]
test_coarse_meshes.py::test_agrees_with_finite_differences[normal map]
test_coarse_meshes.py::test_backward
test_convergence.py::test_error_falls_with_samples[bunny_box]
test_convergence.py::test_error_falls_with_samples[coloured_cube_camera]
test_convergence.py::test_error_falls_with_samples[cornell_box_camera]
test_convergence.py::test_error_falls_with_samples[corner_dolly]
test_convergence.py::test_error_falls_with_samples[open_air]
test_convergence.py::test_error_falls_with_samples[room_camera]
test_convergence.py::test_error_falls_with_samples[room_light]
test_convergence.py::test_error_falls_with_samples[smooth_torus_sun]
test_balance.py::test_derivatives_stay_the_same[open_air
test_from_edges.py::test_edges_find_what_paths_find[on a tray
test_balanced_fits.py::test_integrators_of_interreflections_divide
test_convergence.py::test_error_falls_with_samples[sphere_soft]
test_convergence.py::test_error_falls_with_samples[thin_lens_camera]
test_cuts.py::test_frozen_functions[sunk_cube-cube.vertex_positions-prb_edge]
test_cuts.py::test_frozen_functions[pillar-floor.vertex_positions-prb_edge]
test_instances.py::test_frozen_functions[thing.to_world-prb_edge]
test_instances.py::test_frozen_functions[floor.vertex_positions-prb_edge]
test_instances.py::test_instances_that_stand_still_equal_meshes[lamp.vertex_positions]
test_instances.py::test_instances_that_move_equal_meshes[2]
test_cuts.py::test_gradients_are_those_of_forward_mode[sunk_cube-cube.vertex_positions-prb_edge]
test_cuts.py::test_gradients_are_those_of_forward_mode[sunk_cube-floor.vertex_positions-prb_edge]
test_cuts.py::test_gradients_are_those_of_forward_mode[sunk_cube-sensor.to_world-prb_edge]
test_cuts.py::test_gradients_are_those_of_forward_mode[sunk_sphere-ball.to_world-prb_edge]
test_cuts.py::test_gradients_are_those_of_forward_mode[sunk_sphere-floor.vertex_positions-prb_edge]
test_direct_edge.py::test_forward_and_backward_agree[crop_window]
test_direct_edge.py::test_forward_and_backward_agree[cube_depth]
test_direct_edge.py::test_forward_and_backward_agree[thin_lens_camera]
test_direct_edge.py::test_forward_and_backward_agree[two_triangles_green]
test_direct_edge.py::test_gradients_are_the_sum_of_those_of_the_terms
test_direct_edge.py::test_hard_geometry_gives_finite_gradients[in the plane of the eye-sensor
test_direct_edge.py::test_hard_geometry_gives_finite_gradients[larger than the frame-sensor
test_direct_edge.py::test_other_variants_agree_with_rgb[llvm_ad_mono]
test_distant_lights.py::test_derivatives_of_images[angular_radius
test_distant_lights.py::test_derivatives_of_images[background.value-diffuse]
test_distant_lights.py::test_derivatives_of_images[directions-diffuse]
test_distant_lights.py::test_derivatives_of_images[irradiance
test_docs.py::test_snippets_run[adversarial_scene.md]
test_docs.py::test_snippets_run[bowl_under_many_lights.md]
test_docs.py::test_snippets_run[camera_calibration.md]
test_docs.py::test_snippets_run[check_any_gradient.md]
test_docs.py::test_snippets_run[fits.md]
test_docs.py::test_snippets_run[object_in_a_mirror.md]
test_docs.py::test_snippets_run[photometric_stereo.md]
test_docs.py::test_snippets_run[pose_from_photo.md]
test_docs.py::test_snippets_run[room_materials.md]
test_docs.py::test_snippets_run[shape_from_shadows.md]
test_fine_meshes.py::test_glass[alone]
test_fine_meshes.py::test_light_of_coarse_lamps_backward
test_fine_meshes.py::test_outlines_count_once
test_fit_gradients.py::test_derivative_image_is_that_on_the_way
test_fit_gradients.py::test_gradient_is_that_of_the_loss[camera-shift]
test_fit_gradients.py::test_gradient_is_that_of_the_loss[camera-turn]
test_fit_gradients.py::test_gradient_is_that_of_the_loss[vertex]
test_fit_gradients.py::test_replayed_gradients_are_the_same[direct_edge]
test_fit_gradients.py::test_replayed_gradients_are_the_same[prb]
test_fit_gradients.py::test_replayed_gradients_are_the_same[prb_edge]
test_fit_gradients.py::test_size_of_the_film_changes_and_comes_back
test_fits.py::test_several_starts_find_what_one_does_not
test_freezing.py::test_random_scenes[941650
test_freezing.py::test_random_scenes[941656
test_freezing.py::test_replay_sees_new_values[direct_edge-batch
test_freezing.py::test_replay_sees_new_values[direct_edge-fisheye
test_freezing.py::test_replay_sees_new_values[direct_edge-picture
test_freezing.py::test_replay_sees_new_values[direct_edge-room-light
test_freezing.py::test_replay_sees_new_values[direct_edge-room-sensor
test_freezing.py::test_replay_sees_new_values[direct_edge-sphere
test_freezing.py::test_replay_sees_new_values[direct_edge-torus
test_freezing.py::test_replay_sees_new_values[prb_edge-batch
test_freezing.py::test_replay_sees_new_values[prb_edge-cube
test_freezing.py::test_replay_sees_new_values[prb_edge-fisheye
test_freezing.py::test_replay_sees_new_values[prb_edge-picture
test_freezing.py::test_replay_sees_new_values[prb_edge-room-light
test_freezing.py::test_replay_sees_new_values[prb_edge-room-sensor
test_freezing.py::test_replay_sees_new_values[prb_edge-sphere
test_freezing.py::test_replay_sees_new_values[prb_edge-spot
test_freezing.py::test_replay_sees_new_values[prb_edge-torus
test_freezing.py::test_replay_sees_new_values[prb_edge-two_triangles
test_hard_cases.py::test_closed_room_has_no_boundaries[prb_edge]
test_hard_cases.py::test_closed_room_looks_the_same_from_everywhere
test_hard_cases.py::test_derivatives_do_not_depend_on_the_scale[prb_edge
test_hard_cases.py::test_image_and_derivatives_are_finite[direct_edge-black]
test_hard_cases.py::test_image_and_derivatives_are_finite[direct_edge-glossy]
test_hard_cases.py::test_image_and_derivatives_are_finite[direct_edge-meshes]
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-black
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-glossy
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-grazing, past spheres]
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-light in the floor
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-light on the floor
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-meshes
test_hard_cases.py::test_image_and_derivatives_are_finite[prb_edge-sky
test_hard_cases.py::test_small_scenes_give_finite_derivatives[prb_edge]
test_hard_cases.py::test_white_cube_under_a_white_sky_is_invisible[prb_edge]
test_invariants.py::test_forward_is_backward
test_invariants.py::test_linear_in_the_motion
test_invariants.py::test_nothing_changes_if_all_grows[prb_edge]
test_invariants.py::test_nothing_changes_if_all_moves[prb_edge]
test_invariants.py::test_seams_do_not_count[prb_edge]
test_invariants.py::test_the_derivative_stays[merged-direct_edge]
test_invariants.py::test_the_derivative_stays[subdivided-direct_edge]
test_light_choice.py::test_frozen_functions
test_light_choice.py::test_gradients_are_those_of_forward_mode
test_light_choice.py::test_same_derivative_with_less_noise[integrator1]
test_merl.py::test_table_in_a_render[direct_edge]
test_mirrors.py::test_frozen_functions[over_mirror-prb_edge]
test_mirrors.py::test_frozen_functions_with_normal_maps
test_mirrors.py::test_gradients_are_those_of_forward_mode[bumpy_ball
test_mirrors.py::test_gradients_are_those_of_forward_mode[glass_ball-ball.to_world-prb_edge]
test_mirrors.py::test_gradients_are_those_of_forward_mode[mapped_ball-ball.bsdf.normalmap.data-prb_edge]
test_mirrors.py::test_gradients_are_those_of_forward_mode[mapped_ball-ball.vertex_positions-prb_edge]
test_mirrors.py::test_gradients_are_those_of_forward_mode[over_mirror-cube.vertex_positions-direct_edge]
test_mirrors.py::test_gradients_are_those_of_forward_mode[over_mirror-mirror
test_mirrors.py::test_gradients_are_those_of_forward_mode[two_mirrors
test_mirrors.py::test_texture_coordinates_and_flipped_normals_do_not_change_mirrors
test_mirrors.py::test_two_textures_of_one_shape
test_passes.py::test_backward_is_forward[bdpt_edge
test_passes.py::test_backward_is_forward[prb_edge
test_passes.py::test_derivatives_stay_the_same
test_passes.py::test_frozen
test_photometric_stereo_direct.py::test_coat_needs_evidence
test_photometric_stereo_direct.py::test_colours_under_a_glaze
test_photometric_stereo_rendering.py::test_gradients_with_interreflections[depth
test_photometric_stereo_rendering.py::test_gradients_with_interreflections[normals
test_photometric_stereo_descent.py::test_heights_of_steps_follow_from_their_shadows[orthographic]
test_photometric_stereo_random.py::test_no_set_ends_worse_than_it_starts
test_photometric_stereo_resume.py::test_killed_runs_resume_bit_by_bit
test_prb_edge.py::test_forward_and_backward_agree[vertices
test_prb_edge.py::test_gradients_add_to_what_is_there
test_prb_edge.py::test_other_variants_agree_with_rgb
test_prb_edge.py::test_terms_add_up[vertices-False]
test_reflectance.py::test_dictionary_of_the_package
test_reflectance.py::test_reduction_finds_the_lobes_of_the_tables
test_reflectance.py::test_reduction_keeps_few_alphas_and_etas
test_reproduce.py::test_hidden_light_begins_to_be_found
test_reproduce.py::test_small_fit_converges[ball_of_glass]
test_reproduce.py::test_small_fit_converges[fig6b]
test_reproduce.py::test_small_fit_converges[fig6c]
test_reproduce.py::test_small_fit_converges[fig6d]
test_reproduce.py::test_small_fit_converges[fig6e]
test_reproduce.py::test_small_fit_converges[fig6f]
test_reproduce.py::test_small_fit_converges[pot_in_mirror]
test_rig.py::test_forward_and_backward_agree
test_rig.py::test_frozen_steps[sensor.to_world]
test_rig.py::test_interior_agrees_with_prb_edge[cube.bsdf
test_rig.py::test_interior_agrees_with_prb_edge[cube.vertex_normals
test_rig.py::test_interior_agrees_with_prb_edge[cube.vertex_positions
test_rig.py::test_interior_agrees_with_prb_edge[sensor.to_world-all_kinds]
test_rig.py::test_layers_agree_with_path[False-{'max_depth': 8, 'rr_depth': 2}]
test_rig.py::test_layers_agree_with_path[True-{'max_depth': 8, 'rr_depth': 2}]
test_rig.py::test_monochrome
test_stale.py::test_a_beam_that_comes_to_end_with_a_jump[prb_edge]
test_stale.py::test_a_texture_that_comes_to_jump[checkerboard]
test_stale.py::test_flat_square_is_folded[prb_edge]
test_stale.py::test_material_is_exchanged[prb_edge]
test_stale.py::test_material_is_exchanged[rig]
test_stale.py::test_meshes_in_several_scenes[direct_edge]
test_stale.py::test_meshes_in_several_scenes[prb_edge]
test_stale.py::test_meshes_in_several_scenes[rig]
test_stale.py::test_meshes_that_part[prb_edge]
test_stale.py::test_replay_sees_that_meshes_have_parted[prb_edge]
test_support.py::test_exact_in_these_lights[`area` with a bilinear bitmap, `envmap`, `projector`-passed]
test_support.py::test_exact_on_charts
test_support.py::test_files_equal_meshes_in_memory[obj-face_normals]
test_support.py::test_files_equal_meshes_in_memory[ply-face_normals]
test_support.py::test_files_equal_meshes_in_memory[serialized-face_normals]
test_symmetric_views.py::test_hidden_edges_do_not_count[coloured ball]
test_symmetric_views.py::test_hidden_edges_do_not_count[cube turned about an axis]
"""


def mark(items: Iterable[Any], fast: Any, slow: Any) -> set[str]:
    """Add these marks to the tests that need them. Returns what is listed here of their files, and is no test."""
    fast_modules, fast_cases = set(FAST_MODULES.split()), set(FAST_CASES.split())
    often = fast_cases | set(MORE_CASES.split())
    files: set[str] = set()
    met: set[str] = set()
    for item in items:
        file = item.path.name
        files.add(file)
        if file == "test_derivatives.py":
            case = item.callspec.params["case"].name
            is_fast, is_slow = case in fast_cases, case not in often
            met.add(case)
        else:
            begins = [start for start in SLOW.split("\n") if start and f"{file}::{item.name}".startswith(start)]
            is_fast, is_slow = file[len("test_") : -len(".py")] in fast_modules, bool(begins)
            met.update(begins)
        if is_fast:
            item.add_marker(fast)
        if is_slow:
            item.add_marker(slow)
    listed = {start for start in SLOW.split("\n") if start.partition("::")[0] in files}
    return (listed | (often if "test_derivatives.py" in files else set())) - met
