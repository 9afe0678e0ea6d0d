/* Query the pose of one frame in another: a client written from the .lcm files alone. */
#include <inttypes.h>
#include <lcm/lcm.h>
#include <math.h>
#include <stdio.h>
#include <sys/random.h>
#include <time.h>

#include "mslcm_get_transformation_reply_t.h"
#include "mslcm_get_transformation_request_t.h"

#define REQUEST_CHANNEL "PLATFORM_GET_TRANSFORMATION"
/* Starts with the server's reply prefix, and is the same at every start: programs on the bus store each channel name. */
#define REPLY_CHANNEL "REPLY_EXAMPLE_C"
#define TRIES 3
#define TRY_MS 500

struct waiting
{
    int64_t request_id;
    mslcm_get_transformation_reply_t *reply;
};

static void take(const lcm_recv_buf_t *buffer, const char *channel, const mslcm_get_transformation_reply_t *reply,
                 void *user)
{
    struct waiting *waiting = user;
    (void) buffer;
    (void) channel;
    if (!waiting->reply && reply->header.request_id == waiting->request_id)
        waiting->reply = mslcm_get_transformation_reply_t_copy(reply);
}

static int64_t now_ms(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000LL + now.tv_nsec / 1000000;
}

/* Sends the request until its reply arrives; NULL after the last try. */
static mslcm_get_transformation_reply_t *ask(lcm_t *bus, const mslcm_get_transformation_request_t *request)
{
    struct waiting waiting = {request->header.request_id, NULL};
    mslcm_get_transformation_reply_t_subscription_t *subscription =
        mslcm_get_transformation_reply_t_subscribe(bus, REPLY_CHANNEL, take, &waiting);
    for (int attempt = 0; attempt < TRIES && !waiting.reply; attempt++) {
        int64_t deadline = now_ms() + TRY_MS, left;
        mslcm_get_transformation_request_t_publish(bus, REQUEST_CHANNEL, request);
        while (!waiting.reply && (left = deadline - now_ms()) > 0)
            if (lcm_handle_timeout(bus, (int) left) < 0)
                break;
    }
    mslcm_get_transformation_reply_t_unsubscribe(bus, subscription);
    return waiting.reply;
}

static void show(const mslcm_pose_transform_t *pose)
{
    const double(*h)[4] = pose->h_transform;
    const double degrees = 180.0 / acos(-1.0);
    /* fixed-axis roll, pitch, yaw */
    double level = hypot(h[0][0], h[1][0]);
    double pitch = atan2(-h[2][0], level), roll = 0.0, yaw;
    if (level < 1e-9) { /* gimbal lock: only the difference of roll and yaw is known */
        yaw = atan2(-h[0][1], h[1][1]);
    } else {
        roll = atan2(h[2][1], h[2][2]);
        yaw = atan2(h[1][0], h[0][0]);
    }
    printf("%s in %s\n", pose->frame_of_interest, pose->frame_of_reference);
    printf("position_m %.6f %.6f %.6f\n", h[0][3], h[1][3], h[2][3]);
    printf("rpy_deg %.6f %.6f %.6f\n", roll * degrees, pitch * degrees, yaw * degrees);
    printf("utime %" PRId64 "\n", pose->utime);
    if (pose->pose_valid)
        printf("valid yes\n");
    else
        printf("valid no, reasons 0x%" PRIx32 "\n", (uint32_t) pose->invalid_reasons);
}

int main(int argc, char **argv)
{
    if (argc != 3) {
        fprintf(stderr, "usage: query FRAME_OF_INTEREST FRAME_OF_REFERENCE\n");
        return 2;
    }
    lcm_t *bus = lcm_create(NULL); /* the bus of $LCM_DEFAULT_URL, else LCM's own default, which stays on this machine */
    if (!bus) {
        fprintf(stderr, "query: cannot join the bus: is LCM_DEFAULT_URL right?\n");
        return 1;
    }
    mslcm_get_transformation_request_t request = {
        .header = {.reply_channel = REPLY_CHANNEL},
        .frame_of_interest = argv[1],
        .frame_of_reference = argv[2],
        .time = {.at = 0, .policy = MSLCM_TIME_QUERY_T_INTERPOLATED, .wait_ms = 0},
    };
    if (getrandom(&request.header.request_id, sizeof request.header.request_id, 0) < 0)
        request.header.request_id = now_ms();
    mslcm_get_transformation_reply_t *reply = ask(bus, &request);
    int code = 1;
    if (!reply) {
        fprintf(stderr, "query: no reply after %d tries of %d ms: is the server running?\n", TRIES, TRY_MS);
    } else if (reply->header.status != MSLCM_REPLY_HEADER_T_OK) {
        fprintf(stderr, "query: status %d: %s", reply->header.status, reply->header.message);
        for (int n = 0; n < reply->header.num_nearest; n++)
            fprintf(stderr, "%s%s", n ? ", " : ". Nearest: ", reply->header.nearest[n]);
        fprintf(stderr, "\n");
    } else {
        show(&reply->transform);
        code = 0;
    }
    if (reply)
        mslcm_get_transformation_reply_t_destroy(reply);
    lcm_destroy(bus);
    return code;
}
