import java.io.IOException;
import java.security.SecureRandom;
import java.util.Locale;
import java.util.concurrent.LinkedBlockingQueue;
import java.util.concurrent.TimeUnit;
import lcm.lcm.LCM;
import lcm.lcm.LCMDataInputStream;
import mslcm.get_transformation_reply_t;
import mslcm.get_transformation_request_t;
import mslcm.pose_demand_t;
import mslcm.pose_transform_t;
import mslcm.reply_header_t;
import mslcm.request_header_t;
import mslcm.time_query_t;

/** Query the pose of one frame in another: a client written from the .lcm files alone. */
public final class Query {
    private static final String REQUEST_CHANNEL = "PLATFORM_GET_TRANSFORMATION";
    // Starts with the server's reply prefix, and is the same at every start: programs on the bus store each channel name.
    private static final String REPLY_CHANNEL = "REPLY_EXAMPLE_JAVA";
    private static final int TRIES = 3;
    private static final long TRY_MS = 500;

    private Query() {
    }

    /** Sends the request until its reply arrives; null after the last try. */
    private static get_transformation_reply_t ask(LCM bus, get_transformation_request_t request)
            throws InterruptedException {
        LinkedBlockingQueue<get_transformation_reply_t> replies = new LinkedBlockingQueue<>();
        bus.subscribe(REPLY_CHANNEL, (LCM from, String channel, LCMDataInputStream data) -> {
            try {
                get_transformation_reply_t reply = new get_transformation_reply_t(data);
                if (reply.header.request_id == request.header.request_id) {
                    replies.add(reply);
                }
            } catch (IOException error) {
                // another type: another program publishes on our channel
            }
        });
        for (int attempt = 0; attempt < TRIES; attempt++) {
            bus.publish(REQUEST_CHANNEL, request);
            get_transformation_reply_t reply = replies.poll(TRY_MS, TimeUnit.MILLISECONDS);
            if (reply != null) {
                return reply;
            }
        }
        return null;
    }

    private static void show(pose_transform_t pose) {
        double[][] h = pose.h_transform;
        // fixed-axis roll, pitch, yaw
        double level = Math.hypot(h[0][0], h[1][0]);
        double pitch = Math.atan2(-h[2][0], level);
        // gimbal lock: only the difference of roll and yaw is known
        boolean upright = level < 1e-9;
        double roll = upright ? 0.0 : Math.atan2(h[2][1], h[2][2]);
        double yaw = upright ? Math.atan2(-h[0][1], h[1][1]) : Math.atan2(h[1][0], h[0][0]);
        print("%s in %s%n", pose.frame_of_interest, pose.frame_of_reference);
        print("position_m %.6f %.6f %.6f%n", h[0][3], h[1][3], h[2][3]);
        print("rpy_deg %.6f %.6f %.6f%n", Math.toDegrees(roll), Math.toDegrees(pitch), Math.toDegrees(yaw));
        print("utime %d%n", pose.utime);
        print(pose.pose_valid ? "valid yes%n" : "valid no, reasons 0x%x%n", pose.invalid_reasons);
    }

    private static void print(String format, Object... values) {
        System.out.printf(Locale.ROOT, format, values);
    }

    private static int run(String[] arguments) throws InterruptedException {
        if (arguments.length != 2) {
            System.err.println("usage: query FRAME_OF_INTEREST FRAME_OF_REFERENCE");
            return 2;
        }
        get_transformation_request_t request = new get_transformation_request_t();
        request.header = new request_header_t();
        request.header.request_id = new SecureRandom().nextLong();
        request.header.reply_channel = REPLY_CHANNEL;
        request.frame_of_interest = arguments[0];
        request.frame_of_reference = arguments[1];
        request.time = new time_query_t(); // all zero: the latest time
        request.demand = new pose_demand_t(); // all zero: nothing is asked of the pose
        get_transformation_reply_t reply;
        try {
            // the bus of $LCM_DEFAULT_URL, else LCM's own default, which stays on this machine
            reply = ask(new LCM(), request);
        } catch (IOException error) {
            System.err.println("query: cannot join the bus: " + error.getMessage());
            return 1;
        }
        if (reply == null) {
            System.err.printf("query: no reply after %d tries of %d ms: is the server running?%n", TRIES, TRY_MS);
            return 1;
        }
        if (reply.header.status != reply_header_t.OK) {
            String near = reply.header.num_nearest > 0 ? ". Nearest: " + String.join(", ", reply.header.nearest) : "";
            System.err.printf("query: status %d: %s%s%n", reply.header.status, reply.header.message, near);
            return 1;
        }
        show(reply.transform);
        return 0;
    }

    public static void main(String[] arguments) throws InterruptedException {
        // LCM's receiving thread would keep the program alive
        System.exit(run(arguments));
    }
}
