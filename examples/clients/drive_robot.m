function drive_robot (robot, x_m, y_m)
  % Drives one robot from MATLAB, or from GNU Octave 7 or newer: drive_robot ('r1', 5, 3)
  %
  % Reads the robot, takes its lease, has it drive to a point by a request, drives it for a second by twists, stops it,
  % and releases it. All of it goes behind the safety filter. Environment: FULLSWARM_API, the address that
  % `fullswarm console --api` prints, and FULLSWARM_API_TOKEN, of `fullswarm console tokens add NAME --api`.

  near_m = 0.3;       % so near it counts as arrived: the filter keeps it from a point that another robot has
  patience_s = 60;
  ttl_s = 0.5;        % of a twist: a late one does not stop the robot, a dead program does

  state = api_get (['/robots/' robot]);
  fprintf ('%s at %.2f %.2f: %s\n', robot, state.pose.x_m, state.pose.y_m, state.state);
  api_post ('/leases', struct ('robots', {{robot}}, 'seconds', 120));
  release = onCleanup (@() api_post ('/leases/release', struct ('robots', {{robot}})));

  parameters = struct ('goal', [x_m, y_m]);
  api_post ('/requests', struct ('behaviour', 'move_to_goal_bc', 'robots', {{robot}}, 'parameters', parameters));
  began = tic;
  while hypot (state.pose.x_m - x_m, state.pose.y_m - y_m) >= near_m
    if toc (began) > patience_s
      error ('%s has not arrived: %s', robot, state.stop.text);
    end
    pause (0.2);
    state = api_get (['/robots/' robot]);
  end
  fprintf ('arrived at %.2f %.2f\n', state.pose.x_m, state.pose.y_m);

  accepted = 0;
  began = tic;
  while toc (began) < 1.0
    api_post (['/robots/' robot '/twist'], struct ('linear_m_s', 0.3, 'angular_rad_s', 0.0, 'ttl_s', ttl_s));
    accepted = accepted + 1;
    pause (0.1);
  end
  fprintf ('twists accepted: %d\n', accepted);

  api_post ('/stop', struct ('robots', {{robot}}));
  state = api_get (['/robots/' robot]);
  fprintf ('stopped at %.2f %.2f\n', state.pose.x_m, state.pose.y_m);
end

function found = api_get (path)
  found = plain (webread ([api_address() path], api_options()));
end

function found = api_post (path, body)
  % As a form with one field: Octave's webwrite sends no other body.
  found = plain (webwrite ([api_address() path], 'json', jsonencode (body), api_options()));
end

function found = plain (answer)
  % MATLAB decodes JSON by itself, Octave returns its text.
  if ischar (answer)
    found = jsondecode (answer);
  else
    found = answer;
  end
end

function address = api_address ()
  address = getenv ('FULLSWARM_API');
  if isempty (address)
    address = 'http://127.0.0.1:8807/api/v1';
  end
  address = regexprep (address, '/+$', '');
end

function options = api_options ()
  options = weboptions ('HeaderFields', {'Authorization', ['Bearer ' getenv('FULLSWARM_API_TOKEN')]}, 'Timeout', 10);
end
