% EIDORS for eidors.py: octave-cli eidors.m FOLDER, told on stdin what to do.
%
% FOLDER/work.mat holds the work.  A line "go" has FOLDER/sigma read and FOLDER/result written, both raw float64;
% the seconds taken in between go to stdout.
1;

function fmdl = forward_model (work)
  fmdl = eidors_obj ("fwd_model", "bench", "nodes", work.nodes, "elems", work.elems, "gnd_node", work.ground);
  fmdl.boundary = find_boundary (fmdl.elems);
  fmdl.electrode = struct ("nodes", num2cell (work.electrodes(:).'), "z_contact", 1);
  fmdl.stimulation = stimulation (work.pairs, logical (work.kept));
  fmdl.normalize_measurements = 0;
  % By name: the hash of a handle differs from call to call in Octave, so that EIDORS's cache is of no use.
  fmdl.solve = "fwd_solve_1st_order";
  fmdl.system_mat = "system_mat_1st_order";
  fmdl.jacobian = "jacobian_adjoint";
  if (work.order == 2)
    fmdl.solve = "fwd_solve_higher_order";
    fmdl.system_mat = "system_mat_higher_order";
    fmdl.approx_type = "tri6";
  end
end

function stim = stimulation (pairs, kept)
  n = rows (pairs);
  both = [1:n, 1:n]';
  difference = sparse (both, pairs(:), kron ([1; -1], ones (n, 1)), n, max (pairs(:)));
  for drive = n:-1:1
    stim(drive) = struct ("stim_pattern", difference(drive,:).', "meas_pattern", difference(kept(drive,:),:));
  end
end

% EIDORS keeps what depends on the mesh only; what depends on conductivity is computed anew in each call.
function restrict_cache ()
  for name = {"fwd_solve", "system_mat", "jacobian"}
    eidors_cache ("off", name{1});
  end
end

% The prior of an inverse asks for the Jacobian again: EIDORS keeps it, from one call to the next it must not.
function forget ()
  eidors_cache ("on", "jacobian");
  for name = {"jacobian", "calc_RtR_prior", "calc_jacobian_bkgnd"}
    eidors_cache ("clear_name", name{1});
  end
end

% One way of doing the work, or two: a Jacobian onto pixels through EIDORS's coarse2fine, or over elements times
% the matrix, which is quicker on small meshes and takes gigabytes on large ones.
function ways = ways_of (work)
  img = mk_image (forward_model (work), 1);
  ways = struct ("img", img, "verb", work.verb, "matrix", 1, "hyperparameter", 0);
  if (isfield (work, "hyperparameter"))
    ways.hyperparameter = work.hyperparameter;
  end
  if (strcmp (work.verb, "pipeline"))
    ways.work = work;
  end
  if (isfield (work, "coarse2fine"))
    ways(2) = ways;
    ways(2).verb = [work.verb " by product"];
    ways(2).matrix = work.coarse2fine;
    ways(1).img.fwd_model.coarse2fine = work.coarse2fine;
    ways = ways(1:1 + (rows (work.elems) < 2e4));
  end
end

function way = quickest (ways)
  for k = numel (ways):-1:1
    answer (ways(k));
    [~, seconds(k)] = answer (ways(k));
  end
  [~, best] = min (seconds);
  way = ways(best);
end

function [result, seconds] = answer (way)
  if (strncmp (way.verb, "inverse", 7))
    forget ();
  end
  whole = strncmp (way.verb, "pipeline", 8);
  if (whole)
    eidors_cache ("clear_all");
  end
  start = tic;
  if (whole)
    way.img = from_mesh (way);
  end
  switch (way.verb)
    case "forward"
      result = fwd_solve (way.img).meas;
    case "jacobian"
      result = calc_jacobian (way.img);
    case "jacobian by product"
      result = calc_jacobian (way.img) * way.matrix;
    case "inverse"
      result = one_step (way.img, way.hyperparameter);
    case "inverse by product"
      result = one_step_of (calc_jacobian (way.img) * way.matrix, way.hyperparameter);
    case "pipeline"
      result = one_step (way.img, way.hyperparameter) * way.work.frames;
    case "pipeline by product"
      result = one_step_of (calc_jacobian (way.img) * way.matrix, way.hyperparameter) * way.work.frames;
  end
  seconds = toc (start);
end

% The model made anew, as for a mesh never seen.
function img = from_mesh (way)
  img = mk_image (forward_model (way.work), 1);
  img.elem_data = way.img.elem_data;
  if (strcmp (way.verb, "pipeline") && isfield (way.work, "coarse2fine"))
    img.fwd_model.coarse2fine = way.work.coarse2fine;
  end
end

% What get_RM in inv_solve_diff_GN_one_step.m does, which cannot be called from outside.
function RM = one_step (img, hyperparameter)
  imdl = eidors_obj ("inv_model", "bench", "fwd_model", img.fwd_model);
  imdl.jacobian_bkgnd.elem_data = img.elem_data;
  imdl.hyperparameter.value = hyperparameter;
  imdl.RtR_prior = "prior_noser";
  J = calc_jacobian (calc_jacobian_bkgnd (imdl));
  RtR = calc_RtR_prior (imdl);
  W = calc_meas_icov (imdl);
  hp = calc_hyperparameter (imdl);
  RM = left_divide (J'*W*J + hp^2*RtR, J'*W);
end

% The same of a Jacobian at hand.
function RM = one_step_of (J, hp)
  RtR = spdiags (sqrt (sum (J.^2, 1))', 0, columns (J), columns (J));
  RM = left_divide (J'*J + hp^2*RtR, J');
end

function values = read (name)
  file = fopen (name, "r");
  values = fread (file, Inf, "double");
  fclose (file);
end

function save_raw (name, values)
  file = fopen (name, "w");
  fwrite (file, values, "double");
  fclose (file);
end

function serve (folder)
  work = load (fullfile (folder, "work.mat"));
  way = quickest (ways_of (work));
  puts ("ready\n");
  do
    fflush (stdout);
    line = input ("", "s");  # fgetl would wait for the line after
    if (strcmp (line, "go"))
      way.img.elem_data = read (fullfile (folder, "sigma"));
      [result, seconds] = answer (way);
      save_raw (fullfile (folder, "result"), result);
      printf ("seconds %.9f\n", seconds);
    end
  until (strcmp (line, "stop"))
end

folder = argv (){1};
cd (getenv ("EIDORS"));
startup
eidors_msg ("log_level", 0);
restrict_cache ();
puts ("started\n");
fflush (stdout);
serve (folder);
