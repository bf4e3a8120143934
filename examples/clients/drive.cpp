// Drives one robot from C++ with libcurl and nlohmann/json:
//
//     apt install g++ libcurl4-openssl-dev nlohmann-json3-dev
//     g++ -std=c++17 -O2 -Wall -Wextra drive.cpp -o drive -lcurl && ./drive ROBOT X_M Y_M
//
// Reads the robot, takes its lease, has it drive to a point by a request, drives it for a second by twists, stops it,
// and releases it. All of it goes behind the safety filter. Environment: FULLSWARM_API, the address that
// `fullswarm console --api` prints, and FULLSWARM_API_TOKEN, of `fullswarm console tokens add NAME --api`.

#include <curl/curl.h>

#include <chrono>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <thread>

using nlohmann::json;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

namespace {

constexpr double NEAR_M = 0.3;  // so near it counts as arrived: the filter keeps it from a point that another robot has
constexpr auto PATIENCE = std::chrono::seconds(60);
constexpr auto STEP = milliseconds(50);  // between two twists
constexpr double TTL_S = 0.3;            // six steps: a late one does not stop the robot, a dead program does

std::string environment(const char* name, const std::string& otherwise) {
    const char* value = std::getenv(name);
    return value != nullptr ? value : otherwise;
}

/// The operations of the interface, over one connection.
class Api {
public:
    Api(std::string base, const std::string& token)
        : base_(std::move(base)), handle_(curl_easy_init(), curl_easy_cleanup) {
        if (!handle_) throw std::runtime_error("libcurl cannot be started");
        while (!base_.empty() && base_.back() == '/') base_.pop_back();
        curl_slist* list = curl_slist_append(nullptr, ("Authorization: Bearer " + token).c_str());
        headers_.reset(curl_slist_append(list, "Content-Type: application/json"));
    }

    json get(const std::string& path) { return call(path, nullptr); }

    json post(const std::string& path, const json& body) {
        const std::string text = body.dump();
        return call(path, &text);
    }

private:
    static size_t take(char* data, size_t size, size_t count, void* into) {
        static_cast<std::string*>(into)->append(data, size * count);
        return size * count;
    }

    /// An error has what failed, where, and what to do.
    json call(const std::string& path, const std::string* body) {
        CURL* handle = handle_.get();
        std::string answer;
        curl_easy_reset(handle);  // keeps the connection
        curl_easy_setopt(handle, CURLOPT_URL, (base_ + path).c_str());
        curl_easy_setopt(handle, CURLOPT_HTTPHEADER, headers_.get());
        curl_easy_setopt(handle, CURLOPT_TIMEOUT_MS, 10000L);
        curl_easy_setopt(handle, CURLOPT_WRITEFUNCTION, take);
        curl_easy_setopt(handle, CURLOPT_WRITEDATA, &answer);
        if (body != nullptr) curl_easy_setopt(handle, CURLOPT_POSTFIELDS, body->c_str());
        const CURLcode result = curl_easy_perform(handle);
        if (result != CURLE_OK) throw std::runtime_error(std::string(curl_easy_strerror(result)) + " (" + base_ + ")");
        long status = 0;
        curl_easy_getinfo(handle, CURLINFO_RESPONSE_CODE, &status);
        const json found = json::parse(answer);
        if (status >= 400) {
            throw std::runtime_error(std::to_string(status) + " " + found.value("detail", "") + " (" +
                                     found.value("where", "") + "; " + found.value("hint", "") + ")");
        }
        return found;
    }

    std::string base_;
    std::unique_ptr<CURL, decltype(&curl_easy_cleanup)> handle_;
    std::unique_ptr<curl_slist, decltype(&curl_slist_free_all)> headers_{nullptr, curl_slist_free_all};
};

void wait_arrived(Api& api, const std::string& robot, double x_m, double y_m) {
    const auto end = Clock::now() + PATIENCE;
    while (true) {
        const json state = api.get("/robots/" + robot);
        const json& pose = state["pose"];
        const double east_m = pose["x_m"].get<double>() - x_m, north_m = pose["y_m"].get<double>() - y_m;
        if (std::hypot(east_m, north_m) < NEAR_M) {
            std::cout << "arrived at " << pose << std::endl;
            return;
        }
        if (Clock::now() > end) {
            throw std::runtime_error(robot + " has not arrived: " + state["stop"].value("text", ""));
        }
        std::this_thread::sleep_for(milliseconds(200));
    }
}

void drive_by_twists(Api& api, const std::string& robot, double linear_m_s, milliseconds duration) {
    int accepted = 0;
    const auto end = Clock::now() + duration;
    for (auto next = Clock::now(); next < end; next += STEP) {
        std::this_thread::sleep_until(next);
        api.post("/robots/" + robot + "/twist", {{"linear_m_s", linear_m_s}, {"angular_rad_s", 0.0}, {"ttl_s", TTL_S}});
        ++accepted;
    }
    std::cout << "twists accepted: " << accepted << std::endl;
}

void run(Api& api, const std::string& robot, double x_m, double y_m) {
    const json state = api.get("/robots/" + robot);
    std::cout << robot << " at " << state["pose"] << ": " << state["state"] << std::endl;
    api.post("/leases", {{"robots", {robot}}, {"seconds", 120}});
    try {
        const json parameters = {{"goal", json::array({x_m, y_m})}};
        api.post("/requests", {{"behaviour", "move_to_goal_bc"}, {"robots", {robot}}, {"parameters", parameters}});
        wait_arrived(api, robot, x_m, y_m);
        drive_by_twists(api, robot, 0.3, std::chrono::seconds(1));
        api.post("/stop", {{"robots", {robot}}});
        std::cout << "stopped at " << api.get("/robots/" + robot)["pose"] << std::endl;
    } catch (...) {
        api.post("/leases/release", {{"robots", {robot}}});
        throw;
    }
    api.post("/leases/release", {{"robots", {robot}}});
}

}  // namespace

int main(int count, char** words) {
    const std::string robot = count > 1 ? words[1] : "r1";
    const double x_m = count > 2 ? std::atof(words[2]) : 5.0;
    const double y_m = count > 3 ? std::atof(words[3]) : 3.0;
    curl_global_init(CURL_GLOBAL_DEFAULT);
    int code = 0;
    try {
        Api api(environment("FULLSWARM_API", "http://127.0.0.1:8807/api/v1"), environment("FULLSWARM_API_TOKEN", ""));
        run(api, robot, x_m, y_m);
    } catch (const std::exception& error) {
        std::cerr << error.what() << std::endl;
        code = 1;
    }
    curl_global_cleanup();
    return code;
}
