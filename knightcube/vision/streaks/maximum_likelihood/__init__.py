"""Maximum-likelihood streaks: one rotation and all stars fitted to all pixels of one exposure.

The modules in the order of the computation (`estimate` runs it; `settings` and `result` are its ends):

    pixels
      |  reading              the frame in the pixels that suit it
      |  exposed_frame        light above the background, its noise, pixels to leave out
      |  blobs                bright regions with their moments
      |  seen_spread          how wide the point spread is, by these;  binning  pixels summed for it
      |  glare, mosaic        light that is no streak left out, pixels of unlike responses evened
      v
    first motion
      |  first_guess          the axis by the regions' orientations, the angle by their lengths
      |  angle_scan           the angle by the light on the circles of the brightest regions
      |  whole_frame_scan     the angle by the light of the whole frame, for a doubted motion
      |  hypotheses           rival motions, each fitted to the brightest stars and judged
      v
    faint stars               found along the motion, so that their light is accounted for
      |  polar_grid           the frame on circles about the axis, where streaks are straight
      |  running_sums         the light of each possible streak on these circles
      |  filter_peaks         peaks of these sums
      |  matched_filter       stars with light and significance
      v
    joint fit
      |  joint_fit            which stars are fitted, which of them determine the motion
      |  iteration            evaluate, solve, move, until the motion settles
      |  normal_equations     gradient and information of the pixels;  equation_solver  their solution
      |  agreement            which stars agree with the others
      |  length_correction    a motion too short or too long, by where the light ends
      v
    verdict
      |  end_checks           light from end to end of a streak and none beyond
      |  chains               streaks that are pieces of longer ones
      |  wholeness            whole, doubtful or broken
      |  shutter_direction    either direction of the turn, where a rolling shutter distinguishes them
      |  claim                what is known of the motion, the lens allowed for
      |  lens_errors          how a lens other than described shows;  bent_pinhole  the fit through it
      |  left_over            what the fit leaves over, at the ends and beside;  shaking  what of it is common
      |  result_of_fit        the stars and the rate, or why there is none

Throughout, `work` counts what was done: beyond its limit no rival motion is begun. `course` is how the camera
turned as navigation knows it.

What is fitted is a `scene` (motion, point spread, stars) on `windows` of pixels: `strips` about long streaks,
patches about spots. The model of the light: `motion` (where a star is when), `shutter` (when a row is
exposed), `streak_model` and `spot_model` (its light on the pixels and the derivatives).
"""
